"""The command `turn-credit`: credit for the turns of agents that talk."""

from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import print_line


def turn_credit(
    rollouts: Annotated[Positional[Path], tyro.conf.arg(metavar="ROLLOUTS")],
    out: Annotated[Path, tyro.conf.arg(metavar="CREDITED")],
    report: Annotated[Path | None, tyro.conf.arg(metavar="PAGE")] = None,
    function: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    lambda_: Annotated[float | None, tyro.conf.arg(name="lambda", metavar="FLOAT")] = None,
    logistic: bool = False,
    overwrite: bool = False,
) -> None:
    """Give each turn of an agent's rollouts its credit, from the outcomes of the rollouts, and say how far to trust it.

    Each line of ROLLOUTS is a JSON object: "messages" in the form of OpenAI's chat completions, or "turns" with numbers, or both; an
    "outcome"; and optionally a "group" (the task) and "truncated". CREDITED has the same lines with a key "credit"
    (docs/turn-credit.md).

    Args:
        rollouts: a JSONL file.
        out: the JSONL file to write.
        report: a page to write: some rollouts as strips of turns, what features are worth, and how far to trust it.
        function: a phi over turns (.py): it reads each turn and names its events.
        lambda_: of generalized advantages, 0 to 1. The default is measured: 0.8, 0.95 or 1.
        logistic: model the log odds of outcomes between 0 and 1.
        overwrite: replace --out and --report if they exist.
    """
    from lare_rl.errors import LareError
    from lare_rl.turns.credit import TurnCredit
    from lare_rl.turns.features import tabulate
    from lare_rl.turns.files import read_rollout_file, write_credit_file
    from lare_rl.turns.rollouts import read_rollouts

    for path in (out, report):
        if path is not None and path.exists() and not overwrite:
            raise LareError(f"{path} exists: choose another path, or replace it with --overwrite")
        if path is not None and not path.parent.is_dir():
            raise LareError(f"{path} cannot be written: there is no folder {path.parent}")
    phi = None
    if function is not None:
        from lare_rl.turns.phi import load_turn_phi

        phi = load_turn_phi(function)
    credit = TurnCredit(lambda_, logistic=logistic)
    contents = read_rollout_file(rollouts)
    checked = read_rollouts(contents, phi)
    result = credit.assign(tabulate(checked))
    write_credit_file(out, contents, result)
    for line in result.words:
        print_line(line)
    print_line(f"wrote {out}")
    if report is not None:
        from lare_rl.turns.page import write_turn_report

        print_line(f"wrote {write_turn_report(report, contents, checked, result)}")
