"""Reads tasks from TOML files, and checks them against their environments."""

import os.path
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError, did_you_mean, short_repr
from lare_rl.tasks.spec import NO_ENVIRONMENT, SHARED_KEYS, TaskSpec
from lare_rl.tasks.trust import trust_environment
from lare_rl.util.renamed_fields import rename_keys
from lare_rl.util.safe_io import MAX_SETTINGS_BYTES, read_text, read_toml

__all__ = ["check_environment", "load_task", "read_task", "resolve_path", "resolve_task", "shipped_tasks"]

SHIPPED = files("lare_rl.tasks") / "specs"


def shipped_tasks() -> list[str]:
    """Return the names of the tasks that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in SHIPPED.iterdir() if entry.name.endswith(".toml"))


def resolve_task(task: TaskSpec | str | Path, playable: bool = True) -> TaskSpec:
    """Return a spec unchanged, or read the task of a shipped name or path. Raises `LareError` like `load_task`.

    If `playable`, the environment of a name or path must exist and match the task.
    """
    if isinstance(task, TaskSpec):
        return task
    if isinstance(task, (str, Path)):
        return load_task(task) if playable else read_task(task)
    raise LareError(f"{short_repr(task)} is not a task. Use a shipped name, the path of a task file, or a TaskSpec.")


def load_task(task: str | Path) -> TaskSpec:
    """Read a task and check it against its environment.

    Args:
        task: a shipped name (`shipped_tasks()`), or the path of a TOML file.

    Raises:
        LareError: there is no such task, the file is not a task file, or the environment does not match it.

    >>> load_task("HalfCheetah-v4").action_size
    6
    """
    spec = read_task(task)
    check_environment(spec)
    return spec


def read_task(task: str | Path) -> TaskSpec:
    """Read a task without making its environment. Raises `LareError` like `load_task`."""
    values = _read_values(str(task))
    try:
        spec = TaskSpec(**values)
    except LareError as error:
        raise LareError(f"task {str(task)!r}: {error}") from error
    trust_environment(spec)
    return spec


def check_environment(spec: TaskSpec) -> None:
    """Make the environment and compare it with the task. Raises `LareError` at the first mismatch."""
    # These import NumPy, which listing tasks does not need.
    import numpy as np

    from lare_rl.envs.families import check_logs
    from lare_rl.envs.placement import load_env_spec

    if spec.environment == NO_ENVIRONMENT:
        check_logs(spec)
        return
    env = load_env_spec(spec)
    if spec.evaluation_environment is None:
        return
    other = load_env_spec(spec.evaluation_task)
    for name in ("n_agents", "observation_size", "action_size", "discrete"):
        sizes = getattr(env, name), getattr(other, name)
        if sizes[0] != sizes[1]:
            raise LareError(
                f"task {spec.name!r}: {name} is {sizes[0]} in {spec.environment}, and {sizes[1]} in {spec.evaluation_environment}: both "
                "need the same"
            )
    if [(team.start, team.stop) for team in env.teams] != [(team.start, team.stop) for team in other.teams]:
        raise LareError(
            f"task {spec.name!r}: the teams of {spec.environment} and {spec.evaluation_environment} have different agents: both need "
            "the same"
        )
    if other.masks_actions and not env.masks_actions:
        raise LareError(
            f"task {spec.name!r}: {spec.evaluation_environment} has action masks, and {spec.environment} has none: the policy would "
            "ignore them"
        )
    for name in ("low", "high"):
        if not np.array_equal(getattr(env, name), getattr(other, name)):
            raise LareError(
                f"task {spec.name!r}: the bounds of actions in {spec.environment} and {spec.evaluation_environment} differ: both "
                "need the same"
            )


def _read_values(task: str, ancestors: tuple[str, ...] = (), overrides: Mapping[str, Any] = {}) -> dict[str, Any]:
    """Return the keys of a task file, with those of the task that `like` names, and with the keys of each team's file in `teams`."""
    try:
        values = rename_keys(read_toml(_read_file(task)))
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits
        raise LareError(f"task {task!r} is not valid TOML: {error}") from error
    like, teams, paths = values.pop("like", None), values.pop("teams", None), (*ancestors, os.path.realpath(task))

    def is_valid(name: Any) -> bool:
        return isinstance(name, str) and "\0" not in name and os.path.realpath(resolve_path(task, name)) not in paths

    if not (like is None or is_valid(like)):
        raise LareError(f"task {task!r}: like = {like!r} must be another task, without a cycle")
    if not (teams is None or (isinstance(teams, list) and all(map(is_valid, teams)))):
        raise LareError(f"task {task!r}: teams = {teams!r} must be a list of other tasks, without a cycle")
    values |= overrides  # of the file whose `like` names this one: its teams inherit them too
    if like is not None:
        values = _read_values(resolve_path(task, like), paths, values)
    if teams is not None:
        shared = {key: values[key] for key in SHARED_KEYS if key in values}
        values["teams"] = [shared | _read_values(resolve_path(task, team), paths) for team in teams]
    return values


def _read_file(task: str) -> str:
    if task in shipped_tasks():
        return (SHIPPED / f"{task}.toml").read_text(encoding="utf-8")
    if os.path.isfile(task):
        return read_text(Path(task), MAX_SETTINGS_BYTES)
    if task.endswith(".toml"):
        raise LareError(f"there is no task file {task}")
    if os.path.isdir(task):
        raise LareError(f"{task} is a folder. Name a task file (.toml) or a shipped task (lare-rl tasks lists them).")
    hint = did_you_mean(task, shipped_tasks())
    raise LareError(f"no task {task!r}{hint}. Name a task file, or a shipped task: {', '.join(shipped_tasks())}.")


def resolve_path(task: str, name: str) -> str:
    """Return the path or shipped name of a task that is called `name` in the file of `task`. A path is relative to its folder."""
    path = str(Path(task).parent / name)
    return path if task not in shipped_tasks() and (name.endswith(".toml") or os.path.isfile(path)) else name
