"""Tasks read from TOML files, and checked against their environments."""

import os.path
from importlib.resources import files
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError, did_you_mean, shortened
from lare_rl.tasks.spec import NO_ENVIRONMENT, OF_THE_ENVIRONMENT, TaskSpec
from lare_rl.util.safe_io import LARGEST_SETTINGS, read_text, read_toml

SHIPPED = files("lare_rl.tasks") / "specs"


def shipped_tasks() -> list[str]:
    """Names of the tasks that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def as_task(given: TaskSpec | str | Path, playable: bool = True) -> TaskSpec:
    """A task from a spec, a shipped name, or the path of a file.

    Args:
        given: the spec, the name or the path.
        playable: whether the environment must exist and match the task.

    Raises:
        LareError: `given` is none of these; and as for `load_task`.
    """
    if isinstance(given, TaskSpec):
        return given
    if isinstance(given, (str, Path)):
        return load_task(given) if playable else read_task(given)
    raise LareError(
        f"a task is a shipped name, the path of a task file, or a lare_rl.TaskSpec; it is {shortened(given)}"
    )


def load_task(task: str | Path) -> TaskSpec:
    """Read a task and check it against its environment.

    Args:
        task: a shipped name (`shipped_tasks()`), or the path of a TOML file.

    Raises:
        LareError: there is no such task, the file is not a spec, or the environment does not match the spec.

    >>> load_task("HalfCheetah-v4").action_size
    6
    """
    spec = read_task(task)
    check_against_environment(spec)
    return spec


def read_task(task: str | Path) -> TaskSpec:
    """Read a task without making its environment. Raises `LareError` like `load_task`."""
    values = read_values(str(task))
    try:
        return TaskSpec(**values)
    except LareError as error:
        raise LareError(f"task {str(task)!r}: {error}") from error


def read_values(task: str, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """The keys of a spec. Missing keys are taken from the spec that it is `like`."""
    if task in shipped_tasks():
        text = (SHIPPED / f"{task}.toml").read_text(encoding="utf-8")
    elif is_file(task):
        text = read_text(Path(task), LARGEST_SETTINGS)
    else:
        if task.endswith(".toml"):
            raise LareError(f"there is no task file {task}")
        if task and os.path.isdir(task):
            raise LareError(
                f"{task} is a folder, and a task is a file (.toml) or a shipped name (lare-rl tasks lists them)"
            )
        hint = did_you_mean(task, shipped_tasks())
        raise LareError(
            f"no task {task!r}{hint}: neither a file nor one of the shipped tasks, {', '.join(shipped_tasks())}"
        )
    try:
        values = read_toml(text)
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits
        hint = "; a text needs quotes" if str(error).startswith("Invalid value") else ""
        raise LareError(f"task {task!r} is not valid TOML: {error}{hint}") from error
    like, teams = values.get("like"), values.get("teams")

    def other(name: Any) -> bool:
        return isinstance(name, str) and beside(task, name) not in (*seen, task)

    if not (like is None or other(like)):
        raise LareError(f"task {task!r}: like = {like!r} must be another task, without a cycle")
    if not (teams is None or (isinstance(teams, list) and all(map(other, teams)))):
        raise LareError(f"task {task!r}: teams = {teams!r} must be a list of other tasks, without a cycle")
    if "teams" in values:
        shared = {key: values[key] for key in OF_THE_ENVIRONMENT if key in values}
        values["teams"] = [shared | read_values(beside(task, team), (*seen, task)) for team in values["teams"]]
    parent = values.pop("like", None)
    return values if parent is None else read_values(beside(task, parent), (*seen, task)) | values


def beside(task: str, named: str) -> str:
    """A task that the file of `task` names. A path is relative to the folder of this file."""
    near = str(Path(task).parent / named)
    return near if task not in shipped_tasks() and is_file(near) else named


def is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long, or with a character that no file name has
        return False


def check_against_environment(spec: TaskSpec) -> None:
    """Make the environment and compare it with the spec. Raises `LareError` at the first mismatch."""
    from lare_rl.envs.families import check_logs, env_spec  # here, because it imports JAX: `lare-rl tasks` need not

    if spec.environment == NO_ENVIRONMENT:
        check_logs(spec)
    else:
        env_spec(spec)
