"""Makes Gymnasium environments whose failures are errors of one line."""

import contextlib
import functools
import logging
import os
import warnings
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from lare_rl.envs import mujoco_scores as hidden
from lare_rl.envs import mujoco_sparse as mujoco
from lare_rl.envs.spaces import as_rows
from lare_rl.errors import LareError, shortened

mujoco.register()
hidden.register()


class EnvironmentFault(LareError):
    """An environment returned something that cannot be used for training."""

    place: int | None = None
    """The index of the environment, if several run side by side."""


class Guarded(gymnasium.Wrapper, RecordConstructorArgs):
    """Turns whatever the methods of an environment raise, which is foreign code, into a `LareError` of one line.

    This includes `sys.exit`, which some programs call when a window is closed. Otherwise an interrupted run would look finished.
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
            terminated, truncated = bool(terminated), bool(truncated)  # fails for an array of several
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in step", error) from error
        paid = number(reward, f"environment {self.name!r} gave the reward")
        return observation, paid, terminated, truncated, self.told(info)

    def render(self) -> Any:
        try:
            return self.env.render()
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in render", error) from error

    def close(self) -> None:
        try:
            self.env.close()
        except (Exception, SystemExit) as error:
            raise fault(f"environment {self.name!r} failed in close", error) from error

    def told(self, info: Any) -> dict[str, Any]:
        if not isinstance(info, dict):
            raise LareError(f"environment {self.name!r} gave {shortened(info)} for its info, which is no dictionary")
        return info


def number(value: Any, what: str) -> float:
    """A number from foreign code. Raises `LareError` if the value is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise LareError(f"{what} {shortened(value)}, which is no number") from None


def fault(what: str, error: BaseException, hint: str = "") -> LareError:
    """An error of foreign code as a `LareError` of one line. A `LareError` is returned unchanged."""
    if isinstance(error, LareError):
        return error
    logging.getLogger(__name__).debug("%s", what, exc_info=error)
    reason = str(error).strip().splitlines() or [type(error).__name__]
    return LareError(f"{what}: {reason[0]}{hint}")


def make(environment: str, max_episode_steps: int | None = None, **kwargs: Any) -> gymnasium.Env:
    """`gymnasium.make`, with observations and actions as rows of numbers, and with every failure as a `LareError`.

    The user chooses the version (scores of v4 and v5 cannot be compared), so Gymnasium's advice to upgrade is suppressed.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*Using the latest versioned environment.*")
        try:
            made = gymnasium.make(environment, max_episode_steps=max_episode_steps, **kwargs)
            # The outermost wrapper: making rows may fail too, if the environment's values do not match its spaces.
            return Guarded(as_rows(made), environment)
        except (Exception, SystemExit) as error:  # its constructor may raise anything
            hint, library = "", os.environ.get("MUJOCO_GL")
            if library and isinstance(error, AttributeError):
                hint = f" (is MUJOCO_GL={library} installed?)"
            if isinstance(error, gymnasium.error.NameNotFound) and ":" not in environment:
                hint = f" (for an environment of your own, write MODULE:{environment}, where MODULE registers it)"
            if isinstance(error, ModuleNotFoundError):
                hint = " (a module in this folder is found with PYTHONPATH=.)"
            if "render_mode" in kwargs and "render_mode" in str(error):
                hint = ' (to be filmed, it must accept render_mode="rgb_array")'
            raise fault(f"environment {environment!r} cannot be made", error, hint) from error


@functools.cache
def limit_of(environment: str) -> int | None:
    """An environment's own time limit. Cached, because a run needs it several times and the environment must be made for it."""
    with contextlib.closing(make(environment)) as made:
        return made.spec and made.spec.max_episode_steps


def measured(info: dict, name: str) -> float:
    """The value of a measure of the task in the last step's `info`. Raises `LareError` if it is missing."""
    if name not in info:
        keys = ", ".join(sorted(map(str, info)))
        only = f"has only {keys}" if keys else "is empty (was the episode cut at max_episode_steps?)"
        raise LareError(f"the task measures {name!r}, but the last step's info {only}")
    return number(info[name], f"the task measures {name!r}, and the last step's info has")
