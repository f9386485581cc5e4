"""Gymnasium environments, made so that what goes wrong is said in one line."""

import logging
import os
import warnings
from typing import Any

import gymnasium

from lare.errors import LareError
from lare.tasks import mujoco, particles
from lare.tasks.spaces import as_rows

mujoco.register()
particles.register()


def make(environment: str, max_episode_steps: int | None = None, **kwargs: Any) -> gymnasium.Env:
    """`gymnasium.make`, with rows for observations and actions, and every failure a `LareError`.

    Versions are the user's choice (v4 and v5 scores are never mixed), so Gymnasium's advice to upgrade is left out.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*Using the latest versioned environment.*")
        try:
            return as_rows(gymnasium.make(environment, max_episode_steps=max_episode_steps, **kwargs))
        # An environment is foreign code: anything may come out of its constructor.
        except (Exception, SystemExit) as error:
            logging.getLogger(__name__).debug("making %s failed", environment, exc_info=True)
            reason = str(error).strip().splitlines() or [type(error).__name__]
            hint, library = "", os.environ.get("MUJOCO_GL")
            if library and isinstance(error, AttributeError):
                hint = f" (is MUJOCO_GL={library} installed?)"
            if isinstance(error, ModuleNotFoundError):
                hint = " (a module in this folder is found with PYTHONPATH=.)"
            raise LareError(f"environment {environment!r} cannot be made: {reason[0]}{hint}") from error
