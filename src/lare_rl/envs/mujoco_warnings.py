"""MuJoCo's warnings about the models of environments.

MuJoCo prints a warning, and appends it to a file MUJOCO_LOG.TXT in the working directory. Later versions warn so whenever a
half cheetah is made: its model, a file of Gymnasium, Brax or Playground, uses an attribute that MuJoCo will remove. A user cannot
change that.
"""

import contextlib
import importlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium

from lare_rl.errors import LareError, missing_extra_error

__all__ = ["import_mujoco", "mujoco_warnings"]


def import_mujoco(name: str) -> None:
    """Import MuJoCo if the environment is one of Gymnasium's that need it. Raises `LareError` if it is not installed."""
    spec = gymnasium.registry.get(name)
    if spec is None or not str(spec.entry_point).startswith("gymnasium.envs.mujoco"):
        return
    try:
        importlib.import_module("mujoco")
    except ModuleNotFoundError as missing:
        if missing.name == "mujoco":
            raise missing_extra_error(f"environment {name!r}", "mujoco") from missing
        raise
    except ImportError as error:  # parts of it are missing, after an upgrade say, and it says how to repair that
        raise LareError(" ".join(str(error).split())) from error


@contextlib.contextmanager
def mujoco_warnings(name: str) -> Iterator[None]:
    """Make an environment in this block. MuJoCo's warnings become warnings of Python, except those of deprecated attributes."""
    mujoco: Any = sys.modules.get("mujoco")  # its type stubs lack these functions
    if mujoco is None:
        yield
        return
    messages: list[str] = []
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)
    for message in messages:
        if "deprecated" not in message:
            warnings.warn(f"MuJoCo, environment {name!r}: {message.strip()}", stacklevel=3)
