"""The names of groups of episodes, in arguments and in logs."""

import contextlib
from typing import Any

from lare_rl.errors import LareError, short_repr

__all__ = ["GroupName", "to_group_name"]

GroupName = str | int | float
"""What the name of a group may be. It is the same again when it is read from a file."""


def to_group_name(value: Any, name: str = "a group") -> GroupName:
    """Return a text or a number as Python's own. Raises `LareError` for anything else, which `name` describes."""
    group = value
    with contextlib.suppress(AttributeError, TypeError, ValueError, RuntimeError):  # not a single number
        group = value.item()  # of NumPy, JAX or PyTorch
    if not isinstance(group, GroupName) or group != group:  # NaN
        raise LareError(f"{name} must be a text or a number, and is {short_repr(value)}")
    return group
