"""Masks, and means and choices by them."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

__all__ = ["masked_mean", "select", "step_mask"]

Tree = TypeVar("Tree")


def masked_mean(
    x: Float[Array, "*shape"], mask: Num[Array, "*shape"] | Bool[Array, "*shape"] | None
) -> Float[Array, ""]:
    """Return the mean of x where `mask` is 1. If it is 1 nowhere, return 0. Without a mask, return the mean of all.

    `mask` is 0 or 1. Where it is 0, x must be finite.
    """
    return jnp.mean(x) if mask is None else jnp.sum(x * mask) / jnp.maximum(jnp.sum(mask), 1)


def step_mask(length: Int[Array, " episodes"], n_rows: int) -> Bool[Array, "episodes {n_rows}"]:
    """Return which rows are steps of the episodes. The others are padding."""
    return jnp.arange(n_rows) < length[:, None]


def select(mask: Bool[Array, "*lead"], new: Tree, old: Tree) -> Tree:
    """Return the rows of `new` where `mask` is true, and those of `old` elsewhere. Arrays of `old` have the mask's axes first.

    Arrays of `new` may lack the last of these axes: they are then the same for all rows. Arrays of `old` without these axes stay: some
    simulators have buffers that all rows share.
    """

    def choose(new: Array, old: Array) -> Array:
        if jnp.shape(old)[: mask.ndim] != mask.shape:
            return old
        return jnp.where(mask.reshape(*mask.shape, *[1] * (max(new.ndim, old.ndim) - mask.ndim)), new, old)

    return jax.tree.map(choose, new, old)
