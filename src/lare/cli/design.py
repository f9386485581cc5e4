"""The design of a latent function, by recorded replies or by a live model."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lare.cli.terminal import Data, Kind, Task, free_name, progress, say, steps_of
from lare.errors import LareError
from lare.legible import in_a_line

if TYPE_CHECKING:
    import numpy as np

    from lare.latent.design import DesignFailed
    from lare.latent.function import LatentFunction
    from lare.tasks.spec import TaskSpec

BUDGET, REQUESTS, MINUTES = 400_000, 60, 15.0
"""Tokens, requests and minutes of waiting of one design, at most."""


def design(
    task: Task,
    kind: Kind = "factors",
    model: str | None = None,
    base_url: str | None = None,
    draw: int = 0,
    candidates: int = 5,
    reflect: int = 0,
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    pre_verification: bool = True,
    budget: int = BUDGET,
    requests: int = REQUESTS,
    minutes: float = MINUTES,
    price: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="IN OUT")] = None,
    temperature: float | None = None,
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    data: Data = None,
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
        reflect: further rounds, in which the model sees what returns of whole episodes say of its factors, and may mend them.
        policy: a run whose policy plays the episodes for --reflect; random actions do, unless given.
        pre_verification: without it (the paper's ablation), the first reply is tried once, in its jail, and kept as it is.
        budget: tokens, in and out together: no request is begun that might pass them.
        requests: at most so many requests.
        minutes: to wait for the model, at most, all requests and tries together.
        price: of a million tokens in and out, to have the cost reckoned.
        temperature: of the model; the server's own unless given.
        record: a file that takes every exchange, for --model FILE; it must not exist, and not be the .json of --out.
        data: logged episodes whose steps functions are tried on, instead of random ones of the environment: a directory, a Parquet
            file, or the id of a local data set of Minari's.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    from lare.latent.design import DesignFailed
    from lare.latent.design import design as design_function
    from lare.llm.budget import Budget
    from lare.llm.live import LiveModel
    from lare.llm.model import RECORDED, recorded_model
    from lare.tasks.spec import load_task, read_task

    shipped = model in (None, RECORDED)
    live = not shipped and not str(model).endswith(".json")
    check_design(live, base_url, draw, budget, requests, minutes, price, temperature)
    if policy is not None and not reflect:
        raise LareError("--policy plays episodes for --reflect: say how many rounds")
    if reflect < 0:
        raise LareError(f"reflect = {reflect}: there can be no fewer rounds than none")
    if data is not None and reflect:
        raise LareError(
            "--reflect plays episodes in the environment, and --data is for where there is none: leave one out"
        )
    check_files(out, record)
    spec, cost = load_task(task) if data is None else read_task(task), Budget(requests, budget, 60 * minutes)
    plays = policy_that_plays(policy, spec)
    if live:
        asked = LiveModel(str(model), base_url, temperature, cost, said=progress)
    else:
        asked = recorded_model(spec.name, kind, draw, None if shipped else Path(str(model)))
    try:
        function = design_function(
            spec,
            kind,
            asked,
            candidates=candidates,
            pre_verification=pre_verification,
            record=record,
            said=progress,
            steps=steps_of(data, spec),
        )
        if reflect:
            from lare.training.reflect import reflect as reflect_on

            function = reflect_on(function, spec, asked, reflect, policy=plays, record=record, said=progress)
    except DesignFailed as error:
        progress(f"lare: {in_a_line(error)}")
        keep_attempts(error, free_name(Path(f"{spec.name}.attempts.json")))
        sys.exit(error.status)
    finally:
        if cost.requests_made:
            progress(f"{asked.name}: {cost.summary(price)}")
    if out is None:
        print_function(function, free_name(Path(f"{spec.name}.py")))
    else:
        save_function(function, out)


def keep_attempts(failed: "DesignFailed", instead: Path) -> None:
    """Keep what was said, in its own file or `instead`; where no file can be written, print it: it was paid for."""
    recorder, model = failed.recorder, failed.model
    own = [recorder.path] if recorder.path and recorder.begun else []
    for path in (*own, instead):
        try:
            recorder.write(path, model, new=path not in own)
        except LareError as error:
            progress(f"lare: {in_a_line(error)}")
        else:
            progress(f"every attempt is kept in {path}")
            return
    say(recorder.text(model))


def print_function(function: "LatentFunction", instead: Path) -> None:
    """Print a function; where nothing can be printed it was paid for all the same, and is saved `instead`."""
    try:
        say(function.source)
    except BrokenPipeError:
        raise
    except OSError as error:
        function.save(instead)
        raise LareError(f"nothing can be printed ({error.strerror}); the function is kept in {instead}") from error


def save_function(function: "LatentFunction", out: Path) -> None:
    """Save a function; where it cannot be, it is printed: it was paid for."""
    try:
        function.save(out)
    except LareError:
        say(function.source)
        raise
    say(f"wrote {out.with_suffix('.py')}: {function.size} factors ({', '.join(function.names)})")


def policy_that_plays(run: Path | None, spec: "TaskSpec") -> "Callable[[np.ndarray], np.ndarray] | None":
    """The policy of a run, if there is one."""
    if run is None:
        return None
    from lare.experiments.policy import Policy
    from lare.run.directory import open_run

    opened = open_run(run)
    if opened.config.task.environment != spec.environment:
        raise LareError(f"{run} is a run of {opened.config.task.name}: its policy cannot play {spec.name}")
    return Policy(opened, 0, best=False).row


def check_design(
    live: bool,
    base_url: str | None,
    draw: int,
    budget: int,
    requests: int,
    minutes: float,
    price: tuple[float, float] | None,
    temperature: float | None,
) -> None:
    """Raise `LareError` where options do not go together, or make no sense."""
    if base_url is not None and not live:
        raise LareError("--base-url is for a live model: say which one with --model NAME")
    if draw and live:
        raise LareError("--draw chooses among recordings, and a live model says something new each time: leave it out")
    asked = (budget, requests, minutes, price, temperature) != (BUDGET, REQUESTS, MINUTES, None, None)
    if asked and not live:
        raise LareError(
            "--budget, --requests, --minutes, --price and --temperature are for a live model: say which one with --model NAME"
        )
    for name, value in (("budget", budget), ("requests", requests)):
        if value < 1:
            raise LareError(f"{name} = {value}: at least one is needed")
    if not 0 < minutes < float("inf"):
        raise LareError(f"minutes = {minutes}: a number above 0")
    if price is not None and not all(0 <= one < float("inf") for one in price):
        raise LareError(f"price = {price[0]} {price[1]}: two numbers from 0 on")
    if temperature is not None and not 0 <= temperature < float("inf"):
        raise LareError(f"temperature = {temperature}: a number from 0 on")


def check_files(out: Path | None, record: Path | None) -> None:
    """Raise `LareError` where what is to be written could not be, before a model is asked and paid."""
    written = [] if record is None else [(record, "--record")]
    if out is not None:
        if not out.name:
            raise LareError(f"{out} is not the name of a file; choose another --out")
        written += [(out, "--out"), (out.with_suffix(".py"), "--out"), (out.with_suffix(".json"), "--out")]
    try:
        for path, option in written:
            if path.is_dir():
                raise LareError(f"{path} is not the name of a file; choose another {option}")
            if path.exists() and path != out:
                raise LareError(f"{path} exists, and is not overwritten; choose another {option}")
            if not path.parent.is_dir():
                raise LareError(
                    f"{path} cannot be written: there is no directory {path.parent}; choose another {option}"
                )
        if record is not None and record.resolve() in [path.resolve() for path, option in written if option == "--out"]:
            raise LareError(f"--out writes {record} too: choose another --record")
    except OSError as error:
        raise LareError(f"{error.filename} cannot be written: {error.strerror}") from error
