"""Gymnasium environments, made so that what goes wrong is said in one line."""

import contextlib
import functools
import logging
import os
import warnings
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from lare.errors import LareError, shortened
from lare.tasks import hidden, mujoco
from lare.tasks.spaces import as_rows

mujoco.register()
hidden.register()


class EnvironmentFault(LareError):
    """An environment gave something that cannot be trained on."""

    place: int | None = None
    """Of the environment, where there are several side by side."""


class Guarded(gymnasium.Wrapper, RecordConstructorArgs):
    """An environment is foreign code: whatever its `reset` and `step` raise is a `LareError` of one line.

    So is `sys.exit`, by which a window that is closed ends some programs: a run that has not come to its end must not look as if
    it had.
    """

    def __init__(self, env: gymnasium.Env, name: str):
        RecordConstructorArgs.__init__(self, name=name)  # so that Gymnasium can make the same environment again
        super().__init__(env)
        self.name = name

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        try:
            observation, info = self.env.reset(**options)
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in reset", error) from error
        return observation, self.told(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
            terminated, truncated = bool(terminated), bool(truncated)  # an array of several is neither
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in step", error) from error
        paid = number(reward, f"environment {self.name!r} gave the reward")
        return observation, paid, terminated, truncated, self.told(info)

    def told(self, info: Any) -> dict[str, Any]:
        if not isinstance(info, dict):
            raise LareError(f"environment {self.name!r} gave {shortened(info)} for its info, which is no dictionary")
        return info


def number(value: Any, what: str) -> float:
    """A number that came out of foreign code. Raises `LareError` where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise LareError(f"{what} {shortened(value)}, which is no number") from None


def fault(what: str, error: BaseException, hint: str = "") -> LareError:
    """What went wrong in foreign code, in a line. One that says so itself is left as it is."""
    if isinstance(error, LareError):
        return error
    logging.getLogger(__name__).debug("%s", what, exc_info=error)
    reason = str(error).strip().splitlines() or [type(error).__name__]
    return LareError(f"{what}: {reason[0]}{hint}")


def make(environment: str, max_episode_steps: int | None = None, **kwargs: Any) -> gymnasium.Env:
    """`gymnasium.make`, with rows for observations and actions, and every failure a `LareError`.

    Versions are the user's choice (v4 and v5 scores are never mixed), so Gymnasium's advice to upgrade is left out.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*Using the latest versioned environment.*")
        try:
            made = gymnasium.make(environment, max_episode_steps=max_episode_steps, **kwargs)
            # Outermost: rows are made of what the environment gave, which may not be what its spaces say.
            return Guarded(as_rows(made), environment)
        except (Exception, SystemExit) as error:  # anything may come out of its constructor
            hint, library = "", os.environ.get("MUJOCO_GL")
            if library and isinstance(error, AttributeError):
                hint = f" (is MUJOCO_GL={library} installed?)"
            if isinstance(error, gymnasium.error.NameNotFound) and ":" not in environment:
                hint = f" (one of your own is MODULE:{environment}, where MODULE registers it)"
            if isinstance(error, ModuleNotFoundError):
                hint = " (a module in this folder is found with PYTHONPATH=.)"
            raise fault(f"environment {environment!r} cannot be made", error, hint) from error


@functools.cache
def limit_of(environment: str) -> int | None:
    """The time limit that an environment has of itself. Made once: a run asks more than once."""
    with contextlib.closing(make(environment)) as made:
        return made.spec and made.spec.max_episode_steps


def measured(info: dict, name: str) -> float:
    """What the last step's `info` says of a measure of the task. Raises `LareError` where it says nothing."""
    if name not in info:
        keys = ", ".join(sorted(map(str, info)))
        raise LareError(f"the task measures {name!r}, but the last step's info has only {keys or 'nothing'}")
    return number(info[name], f"the task measures {name!r}, and the last step's info has")
