"""Errors of environments as `LareError`s of one line, because an environment is foreign code that may raise or return anything."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from lare_rl.envs.interface import EnvSpec, Timestep
from lare_rl.errors import LareError, abbreviate, install_command, short_repr
from lare_rl.tasks.spec import MAX_LEVELS, TaskSpec
from lare_rl.util.sanitize import one_line

__all__ = [
    "EnvOutputError",
    "as_lare_error",
    "check_finite",
    "check_group",
    "close_env",
    "convert_output",
    "import_hint",
    "name_step",
    "one_line_errors",
    "read_measures",
    "to_float",
]

T = TypeVar("T")

MAX_ERROR = 300
"""Characters of an environment's error that a message quotes."""


class EnvOutputError(LareError):
    """An environment returned a value that training cannot use. `env_index` is its index, if several run in lockstep."""

    def __init__(self, message: str, env_index: int | None = None):
        super().__init__(message)
        self.env_index = env_index


def as_lare_error(message: str, error: BaseException, hint: str = "") -> LareError:
    """Return a `LareError` with `message`, the error's text in one line, and the hint. Return a `LareError` unchanged."""
    if isinstance(error, LareError):
        return error
    logging.getLogger(__name__).debug("%s", message, exc_info=error)
    text = one_line(error)
    if not text or isinstance(error, KeyError):  # its text is only the key
        text = f"{type(error).__name__} {text}".rstrip()
    return LareError(f"{message}: {abbreviate(text, MAX_ERROR)}{hint}")


@contextlib.contextmanager
def one_line_errors(message: str, make_hint: Callable[[BaseException], str] = lambda _: "") -> Iterator[None]:
    """Turn every error of a block into a `LareError` that begins with `message`, unless it is a `LareError` already.

    This includes `SystemExit`, which some programs raise when a window is closed: the run must not look complete then.
    """
    try:
        yield
    except LareError:  # unchanged, with its cause
        raise
    except (Exception, SystemExit) as error:
        raise as_lare_error(message, error, make_hint(error)) from error


def close_env(env: Any, label: str) -> None:
    """Close an environment. An error becomes a warning: no step depends on it, and it must not hide an earlier error."""
    try:
        env.close()
    except (Exception, SystemExit) as error:
        logging.getLogger(__name__).warning("%s", as_lare_error(f"{label} failed in close", error))


def import_hint(error: BaseException) -> str:
    """Return how to make a missing module available, in brackets, or an empty text for other errors."""
    if not isinstance(error, ModuleNotFoundError):
        return ""
    package = (error.name or "").partition(".")[0]
    if package in ("mujoco", "pettingzoo"):
        return f" (an extra: {install_command(package)})"
    return " (a module in this folder is found with PYTHONPATH=.)"


@contextlib.contextmanager
def name_step(number: int) -> Iterator[None]:
    """Add the number of the step to an `EnvOutputError` of a block. The reset has the number 0."""
    try:
        yield
    except EnvOutputError as error:
        error.args = (f"{error}, at step {number} of the episode",)
        raise


def check_finite(timestep: Timestep, spec: EnvSpec, owner: str) -> None:
    """Raise `EnvOutputError` for the first number of a timestep that is not finite. `owner` is the subject of the message."""
    for name in ("observation", "state", "reward"):
        values = np.asarray(getattr(timestep, name))
        if not np.isfinite(values).all():
            index = tuple(np.argwhere(~np.isfinite(values))[0].tolist())
            agent = "" if name == "state" or spec.n_agents == 1 else f" of {spec.agent_label(index[0])}"
            meaning = spec.entry_meanings.get(index[-1], "") if name == "observation" else ""
            entry = "" if name == "reward" else f" in entry {index[-1]}{meaning and f' ({meaning})'}"
            raise EnvOutputError(f"{owner}: the {name}{agent} contains {values[index]}{entry}")


class NoTimeLimitError(LareError):
    """An episode of the environment may never end."""

    def __init__(self, task: TaskSpec):
        super().__init__(
            f"task {task.name!r}: {task.environment} has no time limit, so an episode may never end. "
            "Set max_episode_steps in the task file, to the length of its longest episode or more."
        )


def convert_output(convert: Callable[[Any], T], value: Any, subject: str) -> T:
    """Return a converted value of an environment. A `ValueError`, whose message is a predicate, becomes an `EnvOutputError`."""
    try:
        return convert(value)
    except ValueError as error:
        raise EnvOutputError(f"{subject} {error}") from None


def to_float(value: Any) -> float:
    """Return a number, or the only one of an array, as a float. Raises `ValueError`, whose message is a predicate, for anything else."""
    try:
        return float(value.item() if getattr(value, "size", None) == 1 else value)
    except (
        TypeError,
        ValueError,
        OverflowError,
        AttributeError,
        RuntimeError,
    ):  # the last one of a tensor of several numbers
        raise ValueError(f"is {short_repr(value)}, which is not a number") from None


def read_measures(
    infos: Sequence[Mapping[Any, Any]], task: TaskSpec, *, first: bool, last: bool
) -> dict[str, Float[np.ndarray, ""]]:
    """Return the measures and the group of the task from each agent's `info`: the means over the agents that report them.

    `first` is whether this is the reset, and `last` whether the episode has ended. Before the end, measures are 0, and so is a group
    that no agent reports, unless the environment may pay for the step. Raises `LareError` if a value that is needed is missing or not
    a number, or if the group of any step is not valid.
    """
    measures = {}
    for name in task.info_keys:
        may_be_paid = task.payment_rule.pays_early and not first
        is_read = last or (name == task.group and (may_be_paid or any(name in info for info in infos)))
        value = _read_measure(infos, name) if is_read else 0.0
        if name == task.group:
            check_group(value, name)
        measures[name] = np.array(value, np.float32)
    return measures


def check_group(value: float, name: str) -> None:
    """Raise `LareError` if the value of a task's group is not valid."""
    if value not in range(MAX_LEVELS):
        raise LareError(f"the group {name!r} in info is {value:g}, not a whole number from 0 to {MAX_LEVELS - 1}")


def _read_measure(infos: Sequence[Mapping[Any, Any]], name: str) -> float:
    try:
        values = [to_float(info[name]) for info in infos if name in info]
    except ValueError as error:
        raise LareError(f"the measure or group {name!r} in info {error}") from None
    if not values:
        keys = ", ".join(sorted({str(key) for info in infos for key in info}))
        content = f"has only {keys}" if keys else "is empty (was the episode cut at max_episode_steps?)"
        raise LareError(f"the task has the measure or group {name!r}, but info {content}")
    return float(np.mean(values))
