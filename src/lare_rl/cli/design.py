"""The command `design`: a latent function from recorded replies or from a live model."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lare_rl.cli.terminal import Data, Kind, Task, free_name, progress, say, steps_of
from lare_rl.errors import LareError
from lare_rl.util.sanitize import in_a_line

if TYPE_CHECKING:
    import numpy as np

    from lare_rl.latent.design import DesignFailed
    from lare_rl.latent.function import LatentFunction
    from lare_rl.tasks.spec import TaskSpec

BUDGET, REQUESTS, MINUTES = 400_000, 60, 15.0
"""The default limits of one design: tokens, requests, and minutes of waiting for the model."""


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

    Prints the function, or writes it to a file that `lare-rl train --function` takes. A live model needs the extra
    lare-rl[llm]; its key comes from the environment variable OPENAI_API_KEY, and is never written down. A server of your own
    that asks for no key, such as Ollama, needs none.

    Args:
        task: a shipped name (see `lare-rl tasks`), or the path of a task file.
        kind: what the function returns: several factors, or one reward.
        model: "recorded" (the shipped recordings, and the default), the path of a recording (.json), or the name of a model
            behind an OpenAI-compatible endpoint.
        base_url: the endpoint; the default is OPENAI_BASE_URL, or else OpenAI's. Ollama's is http://localhost:11434/v1.
        draw: which of the shipped recordings answers (0 to 4).
        candidates: number of first attempts, which are combined; with 1, the attempt itself is the function (the paper's
            ablation without self-prompting).
        reflect: number of further rounds, in which the model sees how well its factors explain the returns of whole episodes,
            and may improve them.
        policy: a run whose policy plays the episodes for --reflect; without it, actions are random.
        pre_verification: verify and correct the function; without (the paper's ablation), the first reply is kept as it is, if
            it can be read.
        budget: largest number of tokens, in and out together; a request that might exceed it is not sent.
        requests: largest number of requests.
        minutes: longest time to wait for the model, over all requests and retries. One reply may take an eighth of it, and at
            least 120 s: raise it for a slow model of your own.
        price: of a million tokens in and of a million out; the cost is then reported.
        temperature: sampling temperature of the model; the default is the server's.
        record: a file to record every exchange in, for --model FILE; it must not exist, and not be the .json of --out.
        data: logged episodes; functions are checked on their steps instead of random steps of the environment. A directory, a
            Parquet file, or the id of a local Minari data set.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    from lare_rl.envs.load import load_task, read_task
    from lare_rl.latent.design import DesignFailed
    from lare_rl.latent.design import design as design_function
    from lare_rl.llm.budget import Budget
    from lare_rl.llm.live import LiveModel
    from lare_rl.llm.model import RECORDED, recorded_model

    shipped = model in (None, RECORDED)
    live = not shipped and not str(model).endswith(".json")
    check_design(live, base_url, draw, budget, requests, minutes, price, temperature)
    if policy is not None and not reflect:
        raise LareError("--policy plays the episodes for --reflect: give --reflect too, with a number of rounds")
    if reflect < 0:
        raise LareError(f"reflect = {reflect}: the number of rounds cannot be negative")
    if data is not None and reflect:
        raise LareError(
            "--reflect plays episodes in the environment, and --data is for tasks without one: leave one of the two out"
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
            from lare_rl.training.reflect import reflect as reflect_on

            function = reflect_on(function, spec, asked, reflect, policy=plays, record=record, said=progress)
    except DesignFailed as error:
        progress(f"lare-rl: {in_a_line(error)}")
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
    """Save the replies, which were paid for, in the recorder's own file or `instead`; print them if no file can be written."""
    recorder, model = failed.recorder, failed.model
    own = [recorder.path] if recorder.path and recorder.begun else []
    for path in (*own, instead):
        try:
            recorder.write(path, model, new=path not in own)
        except LareError as error:
            progress(f"lare-rl: {in_a_line(error)}")
        else:
            progress(f"every attempt is kept in {path}")
            return
    say(recorder.text(model))


def print_function(function: "LatentFunction", instead: Path) -> None:
    """Print a function. If that fails, save it as `instead`, because the model's replies were paid for."""
    try:
        say(function.source)
    except BrokenPipeError:
        raise
    except OSError as error:
        function.save(instead)
        raise LareError(f"nothing can be printed ({error.strerror}); the function is kept in {instead}") from error


def save_function(function: "LatentFunction", out: Path) -> None:
    """Save a function. If that fails, print it, because the model's replies were paid for."""
    try:
        function.save(out)
    except LareError:
        say(function.source)
        raise
    say(f"wrote {out.with_suffix('.py')}: {function.size} factors ({', '.join(function.names)})")


def policy_that_plays(run: Path | None, spec: "TaskSpec") -> "Callable[[np.ndarray], np.ndarray] | None":
    """The policy of a run, if a run is given."""
    if run is None:
        return None
    from lare_rl.evaluation.policy import Policy
    from lare_rl.runs.directory import open_run

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
    """Raise `LareError` if options do not go together, or have no valid value."""
    if base_url is not None and not live:
        raise LareError("--base-url is for a live model: say which one with --model NAME")
    if draw and live:
        raise LareError("--draw chooses a recording, and a live model uses none: leave --draw out")
    asked = (budget, requests, minutes, price, temperature) != (BUDGET, REQUESTS, MINUTES, None, None)
    if asked and not live:
        raise LareError(
            "--budget, --requests, --minutes, --price and --temperature are for a live model: say which one with --model NAME"
        )
    for name, value in (("budget", budget), ("requests", requests)):
        if value < 1:
            raise LareError(f"{name} = {value}: at least one is needed")
    if not 0 < minutes < float("inf"):
        raise LareError(f"minutes = {minutes}: a number above 0 is needed")
    if price is not None and not all(0 <= one < float("inf") for one in price):
        raise LareError(f"price = {price[0]} {price[1]}: two numbers, 0 or more, are needed")
    if temperature is not None and not 0 <= temperature < float("inf"):
        raise LareError(f"temperature = {temperature}: a number, 0 or more, is needed")


def check_files(out: Path | None, record: Path | None) -> None:
    """Raise `LareError` if a file could not be written, before a model is asked and paid."""
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
