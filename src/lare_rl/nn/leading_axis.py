"""A function over the leading axis of arrays: for all rows at once, or for one row after the other."""

from collections.abc import Callable
from typing import TypeVar

import jax

__all__ = ["map_leading_axis"]

Rows = TypeVar("Rows")
Result = TypeVar("Result")


def map_leading_axis(function: Callable[[Rows], Result], rows: Rows, *, vectorized: bool) -> Result:
    """Apply a function to each row of a pytree of arrays.

    Args:
        function: a function of one row.
        rows: arrays with the same leading axis.
        vectorized: `jax.vmap`; else `jax.lax.map`, which is faster on a CPU.
    """
    return jax.vmap(function)(rows) if vectorized else jax.lax.map(function, rows)
