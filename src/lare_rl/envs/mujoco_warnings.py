"""MuJoCo's warnings about the models of environments, which it prints and appends to MUJOCO_LOG.TXT in the working directory.

MuJoCo 4 warns whenever a half cheetah is made: its model, a file of Gymnasium, Brax or Playground, uses a deprecated attribute, which
a user cannot change.
"""

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

__all__ = ["mujoco_warnings"]


@contextlib.contextmanager
def mujoco_warnings(name: str) -> Iterator[None]:
    """Turn MuJoCo's warnings in a block that makes an environment into Python's, and drop those about deprecated attributes."""
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
