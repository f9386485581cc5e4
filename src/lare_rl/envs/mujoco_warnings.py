"""MuJoCo's warnings about the models of environments.

MuJoCo prints a warning, and appends it to a file MUJOCO_LOG.TXT in the working directory. Later versions warn so whenever a
half cheetah is made: its model, a file of Gymnasium, Brax or Playground, uses an attribute that MuJoCo will remove. A user cannot
change that.
"""

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

__all__ = ["mujoco_warnings"]


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
