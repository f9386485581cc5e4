"""The commands `turn-credit` and `turn-phi`: credit for the turns of agents that talk, and the events of their turns."""

from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.design import check_function_files, record_replies
from lare_rl.cli.terminal import DEFAULT_LIVE, LiveOptions, print_line, print_messages
from lare_rl.errors import LareError
from lare_rl.util.files import check_new_path, write_bytes
from lare_rl.util.sanitize import one_line


def turn_credit(
    rollouts: Annotated[Positional[Path], tyro.conf.arg(metavar="ROLLOUTS")],
    out: Annotated[Path, tyro.conf.arg(metavar="CREDITED")],
    report: Annotated[Path | None, tyro.conf.arg(metavar="PAGE")] = None,
    function: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    lambda_: Annotated[float | None, tyro.conf.arg(name="lambda", metavar="FLOAT")] = None,
    overwrite: bool = False,
) -> None:
    """Give each turn of an agent's rollouts its credit, from the outcomes of the rollouts. Says how far to trust it.

    Each line of ROLLOUTS is a JSON object: "messages" in the form of OpenAI's chat completions, or "turns" with numbers, or both; an
    "outcome"; and optionally a "group" (the task) and "truncated". CREDITED has the same lines with a key "credit"
    (docs/reference/logs.md).

    Args:
        rollouts: a JSONL file.
        out: the JSONL file to write.
        report: a page to write: some rollouts as strips of turns, the effects of features, and how far to trust the credit.
        function: a phi over turns (.py): it reads each turn and names its events.
        lambda_: of generalized advantages, 0 to 1. The default is measured: 0.8, 0.95 or 1.
        overwrite: replace --out and --report if they exist.
    """
    from lare_rl.turns.credit import TurnCredit
    from lare_rl.turns.features import tabulate
    from lare_rl.turns.files import read_rollout_file, write_credit_file
    from lare_rl.turns.phi import load_turn_phi
    from lare_rl.turns.rollouts import read_rollouts

    check_new_path(out, "--out", overwrite)
    if report is not None:
        check_new_path(report, "--report", overwrite)
    # --out may be ROLLOUTS, whose lines are kept.
    clashes = (
        ("--out", out, "--function", function),
        *(
            ("--report", report, name, path)
            for name, path in (("--out", out), ("--function", function), ("ROLLOUTS", rollouts))
        ),
    )
    for option, written, name, path in clashes:
        if written is not None and path is not None and written.resolve() == path.resolve():
            raise LareError(f"{option} {written} is {name}, too: choose another {option}")
    phi = None if function is None else load_turn_phi(function)
    credit = TurnCredit(lambda_)
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


def turn_phi(
    rollouts: Annotated[Positional[Path], tyro.conf.arg(metavar="ROLLOUTS")],
    tools: Annotated[Path, tyro.conf.arg(metavar="TOOLS")],
    goal: str,
    model: str | None = None,
    live: Annotated[LiveOptions, tyro.conf.arg(name="")] = DEFAULT_LIVE,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Let a language model write a phi over turns, which names the events of each turn for `turn-credit --function`.

    Without --model, prints the request, with which you can ask a model by hand. With it, the function is checked on the turns of ROLLOUTS
    and corrected until it passes. A live model needs the extra lare-rl[llm]; its key comes from the environment variable
    OPENAI_API_KEY (see `lare-rl design --help`).

    Args:
        rollouts: a JSONL file of rollouts with messages.
        tools: a JSON file: the list of tools in the form of OpenAI's chat completions.
        goal: what the agent is to do, in a few sentences.
        model: the name of a model behind an OpenAI-compatible endpoint.
        live: options of the model.
        out: a .py file to write, with the model's replies in a .json beside it; they must not exist. The default is to print the function.
    """
    from lare_rl.turns.design import choose_examples, design_turn_phi, turn_request
    from lare_rl.turns.files import read_rollout_file, read_tool_file
    from lare_rl.turns.messages import split_turns

    descriptions, turns = read_tool_file(tools), []
    for number, rollout in enumerate(read_rollout_file(rollouts)):
        turns += split_turns(rollout.get("messages"), f"{rollouts}, rollout {number}")
    if not turns:
        raise LareError(f"{rollouts} has no message of an assistant")
    if model is None:
        if out is not None or live != DEFAULT_LIVE:
            raise LareError(
                "--out and the options of a live model need --model NAME: without it, only the request is printed"
            )
        print_messages(turn_request(goal, descriptions, choose_examples(turns)))
        return
    out = check_function_files(out)
    record = None if out is None else out.with_suffix(".json")
    live_model = live.open(model)
    with record_replies("turns", live_model, live, record) as recording:
        phi = design_turn_phi(goal, descriptions, turns, live_model, record=recording)
        if out is None:
            print_line(phi.source)
            return
        write_bytes(out, f"# A phi over turns, by {one_line(phi.model)}.\n{phi.source}\n".encode())
        print_line(f"wrote {out} and {record}")
