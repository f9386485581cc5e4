"""Latent functions: the request, a task of one's own, design, verification."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare.cli.terminal import Kind, Task, free_name, progress, say, write_new
from lare.errors import LareError


def prompt(task: Task, kind: Kind = "factors") -> None:
    """Print the request that a language model gets for a task.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
    """
    from lare.llm.prompts import candidate
    from lare.tasks.spec import load_task, the_role

    for message in candidate(the_role(load_task(task)), kind):
        say(f"--- {message['role']} ---\n{message['content']}\n")


def new_task(
    environment: Annotated[Positional[str], tyro.conf.arg(metavar="ENV_ID")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Write a first task file of a Gymnasium environment, from its spaces and its documentation.

    Whatever speaks of rewards is left out, and what could not be found is marked for you to fill in.

    Args:
        environment: a Gymnasium id, as Pendulum-v1; module:id imports the module that registers it first.
        out: the file to write, which must not exist; ENV_ID.toml unless given.
    """
    from lare.tasks.new import draft

    drafted = draft(environment)
    path = out or Path(f"{environment.rpartition(':')[2].replace('/', '-')}.toml")
    write_new(path, drafted.toml, "--out")
    say(f"wrote {path}; {drafted.left_out} sentences or rows that spoke of rewards were left out")
    for key in drafted.missing:
        say(f"  fill in: {key} (the environment does not document it)")
    say(f"read it, then: lare prompt {path}; lare design {path} --model NAME --out phi.py")


def design(
    task: Task,
    kind: Kind = "factors",
    model: str | None = None,
    base_url: str | None = None,
    draw: int = 0,
    candidates: int = 5,
    reflect: int = 0,
    pre_verification: bool = True,
    budget: int = 400_000,
    requests: int = 60,
    price: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="IN OUT")] = None,
    temperature: float | None = None,
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Design the latent function of a task: candidates, combine, verify, correct.

    Prints the function, or writes it to a file that `lare train --function` takes. A live model needs the extra
    lare-rl[llm]; its key comes from the environment variable OPENAI_API_KEY, and is never written down.

    Args:
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what is asked for: several factors, or one reward.
        model: whom to ask: "recorded" (the shipped recordings, and the default), the path of a recording (.json), or
            the name of a model behind an OpenAI-compatible endpoint.
        base_url: the endpoint (OpenAI's, or that of OPENAI_BASE_URL, unless given); http://localhost:11434/v1 is Ollama's.
        draw: which of the shipped recordings answers (0 to 4).
        candidates: first attempts that are combined; with 1, the attempt itself is the function (the paper's ablation
            without self-prompting).
        reflect: further rounds, in which the model sees how its factors go with the return, and may improve them.
        pre_verification: without it (the paper's ablation), the first reply is tried once, in its jail, and kept as it is.
        budget: tokens, in and out together, that are never passed.
        requests: requests that are never passed.
        price: of a million tokens in and out, to have the cost reckoned.
        temperature: of the model; the server's own unless given.
        record: a file that takes every exchange, for --model FILE; it must not exist.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    from lare.latent.design import DesignFailed
    from lare.latent.design import design as design_function
    from lare.llm.live import Budget, LiveModel
    from lare.llm.model import RECORDED, recorded_model
    from lare.tasks.spec import load_task

    for path in (out.with_suffix(".py"), out.with_suffix(".json")) if out is not None and out.name else ():
        if path.exists():
            raise LareError(f"{path} exists, and is not overwritten; choose another --out")
    spec, cost = load_task(task), Budget(requests, budget)
    if model is None or model == RECORDED:
        asked = recorded_model(spec.name, kind, draw)
    elif model.endswith(".json"):
        asked = recorded_model(spec.name, kind, path=Path(model))
    else:
        asked = LiveModel(model, base_url, temperature, cost, said=progress)
    try:
        function = design_function(
            spec,
            kind,
            asked,
            candidates=candidates,
            reflect=reflect,
            pre_verification=pre_verification,
            record=record,
            said=progress,
        )
    except DesignFailed as error:
        path = record or free_name(Path(f"{spec.name}.attempts.json"))
        if record is None:
            error.recorder.write(path, error.model)
        progress(f"lare: {error}\nevery attempt is kept in {path}")
        sys.exit(1)
    finally:
        if cost.requests_made:
            progress(f"{asked.name}: {cost.summary(price)}")
    if out is None:
        say(function.source)
    else:
        function.save(out)
        say(f"wrote {out.with_suffix('.py')}: {function.size} factors ({', '.join(function.names)})")


def verify(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    task: Annotated[str, tyro.conf.arg(metavar="TASK")],
    kind: Kind = "factors",
) -> None:
    """Verify a function: what it may contain, and what it must do. It runs in a process without rights.

    Exit status 0: it passes. 1: it does not, and every reason is printed. 2: it could not be tried.

    Args:
        file: Python source, or a function that `lare design` saved.
        task: a shipped name (see `lare tasks`), or the path of a task file.
        kind: what it is to return: several factors, or one reward.
    """
    from lare.latent.function import read_source
    from lare.latent.verify import verify as verify_source
    from lare.tasks.spec import load_task

    verdict = verify_source(read_source(file), load_task(task), kind)
    for check in verdict.checks:
        say(f"{'passed' if check.passed else 'FAILED'}  {check.name}")
        for line in check.message.splitlines():
            say(f"        {line}")
    for line in verdict.advice:
        say(f"advice  {line}")
    if verdict.isolation:
        say(f"It ran in {verdict.isolation}.")
    if not verdict.passed:
        sys.exit(1)
