"""The command `design`: a latent function from recorded replies or from a live model."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from lare_rl.cli.terminal import (
    DEFAULT_LIVE,
    Data,
    Kind,
    LiveOptions,
    Task,
    load_playing_policy,
    load_steps,
    print_line,
    print_progress,
)
from lare_rl.errors import LareError
from lare_rl.llm.prompts import N_CANDIDATES, FunctionKind
from lare_rl.util.files import check_new_path, find_free_path

if TYPE_CHECKING:
    from lare_rl.llm.model import Model
    from lare_rl.tasks.spec import TaskSpec


def design(
    task: Task,
    kind: Kind = "factors",
    model_name: Annotated[str | None, tyro.conf.arg(name="model", metavar="STR")] = None,
    live: Annotated[LiveOptions, tyro.conf.arg(name="")] = DEFAULT_LIVE,
    draw: int = 0,
    candidates: int = N_CANDIDATES,
    reflect: int = 0,
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    pre_verification: bool = True,
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    data: Data = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Design the latent function of a task: candidates, combine, verify, correct.

    Prints the function, or writes it to a file that `lare-rl train --function` takes. A live model needs the extra
    lare-rl[llm]; its key comes from the environment variable OPENAI_API_KEY, and is never written down. A server of your own
    that asks for no key, such as Ollama, needs none. After an error, its replies are in TASK.attempts.json.

    Args:
        model_name: "recorded" (the shipped recordings, and the default), the path of a recording (.json), or the name of a model
            behind an OpenAI-compatible endpoint.
        live: options of a live model.
        draw: which of the shipped recordings answers (0 to 4).
        candidates: number of first attempts, which are combined; with 1, the attempt itself is the function (the paper's
            ablation without self-prompting).
        reflect: number of further rounds, in which the model sees how well its factors explain the returns of whole episodes,
            and may improve them.
        policy: a run whose policy plays the episodes for --reflect; without it, actions are random.
        pre_verification: verify and correct the function; without (the paper's ablation), the first reply that can be read is kept.
        record: a file to record every exchange in, for --model FILE; it must not exist, and not be the .json of --out.
        out: a .py file to write, with the replies and checks in a .json beside it; it must not exist.
    """
    import lare_rl
    from lare_rl.envs.load import read_task
    from lare_rl.llm.model import recorded_model
    from lare_rl.llm.recording import RECORDED

    model_name = RECORDED if model_name is None else model_name
    path = None if model_name == RECORDED else Path(model_name)
    is_live = path is not None and path.suffix != ".json"
    live_options = ", ".join(f"--{name.replace('_', '-')}" for name in LiveOptions.model_fields)
    problems = [
        (path and draw, "--draw chooses a shipped recording, and --model names another model: leave --draw out"),
        (not is_live and live != DEFAULT_LIVE, f"{live_options} are for a live model: name it with --model NAME"),
        (policy and not reflect, "--policy plays the episodes for --reflect: give --reflect a number of rounds"),
        (reflect < 0, f"reflect = {reflect}: the number of rounds cannot be negative"),
        (data and reflect, "--reflect plays episodes, and --data is for tasks without an environment: leave one out"),
    ]
    for applies, message in problems:
        if applies:
            raise LareError(message)
    out = check_function_files(out, record)
    spec = lare_rl.load_task(task) if data is None else read_task(task)
    play, steps = load_playing_policy(policy, spec), load_steps(data, spec)
    model = live.open(model_name) if is_live else recorded_model(spec.name, kind, draw, path)
    options: dict[str, Any] = {"candidates": candidates, "pre_verification": pre_verification, "steps": steps}
    with record_replies(spec.name, model, live, record) as recording:
        outputs: dict[str, Any] = {"record": recording, "on_message": print_progress}
        function = lare_rl.design(spec, kind, model, **options, **outputs)
        if reflect:
            function = lare_rl.reflect(function, spec, model, reflect, policy=play, **outputs)
        if out is None:
            print_line(function.source)
        else:
            function.save(out)
            print_line(f"wrote {out}: {function.size} factors ({', '.join(function.names)})")
            print_line(_next_command(task, spec, out, kind, data))


@contextmanager
def record_replies(name: str, model: "Model", live: LiveOptions, record: Path | None) -> Iterator[Path | None]:
    """Yield the file in which replies are recorded. Print what a live model has cost.

    Without `record`, it is NAME.attempts.json for a live model, whose replies are paid for. This file stays only after an error.
    If the last reply could not be saved, all are printed.
    """
    from lare_rl.latent.design import DesignError
    from lare_rl.llm.live import LiveModel

    if not isinstance(model, LiveModel):
        yield record
        return
    path = record or find_free_path(Path(), f"{name}.attempts", ".json")
    try:
        yield path
        if record is None:
            path.unlink(missing_ok=True)
    except BaseException as error:
        has_replies = isinstance(error, DesignError)
        # The disk may be full, or another design may have taken the name.
        if has_replies and not error.recorder.is_saved:
            print_line(error.recorder.to_json())
        elif has_replies or (model.budget.requests_used and path.exists()):  # a file that existed before is not ours
            print_progress(f"every reply is kept in {path}")
        raise
    finally:
        if model.budget.requests_used:
            print_progress(f"{model.name}: {model.budget.summary(live.price)}")


def _next_command(task: str, spec: "TaskSpec", out: Path, kind: FunctionKind, data: str | None) -> str:
    """Return what to do with a new function."""
    task, function = shlex.quote(task), shlex.quote(str(out))
    if spec.team is not None:
        return f"to train with it: lare-rl train TASK --function {function}, with a --function for each team of TASK"
    if data is not None:
        return f"to use it: lare-rl relabel {shlex.quote(data)} --task {task} --function {function} --out NEW"
    method = " --method llm-reward" if kind == "reward" else ""
    return f"to train with it: lare-rl train {task} --function {function}{method}"


def check_function_files(out: Path | None, record: Path | None = None) -> Path | None:
    """Return the .py file of `out`, which has a .json beside it. Raise `LareError` if a file cannot be written.

    This comes before a model is asked, and paid.
    """
    from lare_rl.latent.function import python_file

    files = []
    if out is not None:
        check_new_path(out, "--out", overwrite=True)  # it may be a directory
        out = python_file(out)
        files = [out, out.with_suffix(".json")]
    for path in files:
        check_new_path(path, "--out")
    if record is not None:
        check_new_path(record, "--record")
        if record.resolve() in [path.resolve() for path in files]:
            raise LareError(f"--out writes {record} too: choose another --record")
    return out
