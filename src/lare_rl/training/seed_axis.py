"""The seed axis: the leading axis of every array of a run."""

from typing import TypeVar

import jax
from jaxtyping import Array, Int

__all__ = ["select_seed"]

State = TypeVar("State")


@jax.jit
def select_seed(state: State, seed_index: int | Int[Array, ""] = 0) -> State:
    """Return the part of a training state that belongs to one seed."""
    return jax.tree.map(lambda leaf: leaf[seed_index], state)
