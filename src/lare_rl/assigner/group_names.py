"""The names of groups of episodes, in arguments and in logs."""

from typing import Any

import numpy as np

from lare_rl.errors import LareError, short_repr

__all__ = ["GroupName", "to_group_name"]

GroupName = str | int | float
"""What the name of a group may be. It is the same again when it is read from a file."""


def to_group_name(value: Any, name: str = "a group") -> GroupName:
    """Return a text or a number as Python's own. Raises `LareError` for anything else, which `name` describes."""
    group = value.item() if hasattr(value, "item") and np.size(value) == 1 else value  # of NumPy, JAX or PyTorch
    if not isinstance(group, GroupName) or group != group:  # NaN
        raise LareError(f"{name} must be a text or a number, and is {short_repr(value)}")
    return group
