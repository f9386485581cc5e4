"""Observations and actions of any Gymnasium space as vectors of numbers."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from jaxtyping import Float

from lare_rl.errors import LareError, short_repr

__all__ = ["check_spaces", "flatten_value", "float_array"]


def check_spaces(owner: Any, observation: gymnasium.Space, action: gymnasium.Space) -> None:
    """Raise `LareError` if observations cannot be flattened, or actions are neither discrete nor bounded.

    `owner` is the name of the environment or agent, for the message.
    """
    if not observation.is_np_flattenable:
        raise LareError(f"the observation space of {owner} is {short_repr(observation)}, which cannot be flattened")
    if not isinstance(action, Discrete | Box):
        raise LareError(
            f"the action space of {owner} is {short_repr(action)}, neither a Discrete nor a Box. Turn several discrete actions "
            "into one Discrete of all their combinations, or into a Box whose numbers the environment rounds."
        )
    if isinstance(action, Box) and not action.is_bounded():
        raise LareError(f"the actions of {owner} have no bounds: {short_repr(action)}")


def flatten_value(space: gymnasium.Space, value: Any) -> Float[np.ndarray, " size"]:
    """Return a value of a space as a new vector, like `gymnasium.spaces.flatten`, which does not check values.

    Raises `ValueError` if the value is not in the space. The message is a predicate, such as "has the shape (3,), not (2,)".
    """
    if isinstance(space, Box):
        return float_array(value, space.shape).ravel()
    if isinstance(space, Dict):
        if not isinstance(value, Mapping) or set(value) != set(space.spaces):
            raise ValueError(f"must have the keys {', '.join(map(str, space.spaces))}, but is {short_repr(value)}")
        return _flatten_all((subspace, value[key]) for key, subspace in space.spaces.items())
    if isinstance(space, Tuple):
        if not isinstance(value, Sequence) or len(value) != len(space.spaces):
            raise ValueError(f"must have {len(space.spaces)} elements, but is {short_repr(value)}")
        return _flatten_all(zip(space.spaces, value, strict=True))
    if not _contains(space, value):
        raise ValueError(f"is {short_repr(value)}, which is not in {short_repr(space)}")
    return np.array(gymnasium.spaces.flatten(space, value), np.float32)


def _contains(space: gymnasium.Space, value: Any) -> bool:
    try:
        return space.contains(value)
    except OverflowError:  # Gymnasium before 1.4 converts to an integer of 64 bits first
        return False


def _flatten_all(pairs: Iterable[tuple[gymnasium.Space, Any]]) -> Float[np.ndarray, " _"]:
    """Return the values of several spaces, one after the other, in one vector."""
    return np.concatenate([np.zeros(0, np.float32), *(flatten_value(space, value) for space, value in pairs)])


def float_array(value: Any, shape: tuple[int, ...] | None = None) -> Float[np.ndarray, "..."]:
    """Return a value as a new float32 array.

    Raises `ValueError`, whose message is a predicate, if it is not an array of numbers or does not have this shape.
    """
    try:
        # Numbers beyond float32 become infinite, which `check_finite` refuses. A simulator may have set NumPy to raise.
        with np.errstate(all="ignore"):
            array = np.array(value, np.float32)  # a copy: the environment may write the next value into the same memory
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"is {short_repr(value)}, which is not an array of numbers") from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"has the shape {array.shape}, not {shape}")
    return array
