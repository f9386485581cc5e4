"""How the steps of several episodes are laid out in the rows of one batch.

Lengths 3, 2 and 4 give, with 8 rows:

    packed   slot    0 0 0  1 1  - - -        padded to 4   slot    0 0 0 0  1 1 1 1  2 2 2 2
             step    0 1 2  0 1  - - -                      step    0 1 2 2  0 1 1 1  0 1 2 3

`slot` is the index of a row's episode in the batch, and `step` the index of the row's step in that episode. A row that belongs to no
episode has the number of episodes as its slot. The functions that lay steps out work on arrays of NumPy and of JAX.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

__all__ = ["Layout", "lay_out_packed", "lay_out_padded", "lay_out_sampled", "sample_steps"]


class Layout(NamedTuple):
    """The step of each row. Both arrays are of NumPy or both of JAX."""

    slot: Any
    """[rows]: the index of the row's episode; for padding, the number of episodes."""
    step: Any
    """[rows]: the index of the step in its episode."""


def lay_out_packed(length: Any, mask: Any, rows: int) -> tuple[Layout, Any]:
    """Put whole episodes one after the other.

    Args:
        length: [episodes] the number of steps of each episode.
        mask: [episodes] 0 for an episode that is not part of the batch. All of them must come last.
        rows: the number of rows. An episode that does not fit, and all after it, are left out.

    Returns:
        The layout, and the mask of the episodes that fit.
    """
    xp = jnp if isinstance(length, jax.Array) else np
    end = xp.cumsum(length)
    mask = mask * (end <= rows)
    row = xp.arange(rows)
    slot = xp.minimum(xp.searchsorted(end, row, side="right"), len(length) - 1)
    is_step = (mask[slot] > 0) & (row < end[slot])
    step = xp.where(is_step, row - (end - length)[slot], 0)
    return Layout(xp.where(is_step, slot, len(length)), step), mask


def lay_out_padded(length: Any, rows_per_episode: int) -> Layout:
    """Give each episode the same number of rows. Its last step is repeated in the rows that are left over.

    Args:
        length: [*batch episodes] the number of steps of each episode.
        rows_per_episode: at least the largest length.

    Returns:
        Arrays of shape [*batch episodes rows_per_episode].
    """
    xp = jnp if isinstance(length, jax.Array) else np
    step = xp.minimum(xp.arange(rows_per_episode), length[..., None] - 1)
    return Layout(xp.broadcast_to(xp.arange(length.shape[-1])[:, None], step.shape), step)


def lay_out_sampled(length: Any, step: Any) -> Layout:
    """Use K steps of each episode. An episode with T < K steps has T rows; its other rows are padding.

    Args:
        length: [*batch episodes] the number of steps of each episode.
        step: [*batch episodes K] from `sample_steps`.
    """
    xp = jnp if isinstance(length, jax.Array) else np
    count = length.shape[-1]
    is_step = xp.arange(step.shape[-1]) < length[..., None]
    return Layout(xp.where(is_step, xp.arange(count)[:, None], count), step)


def sample_steps(key: PRNGKeyArray, length: Int[Array, "*episodes"], steps: int) -> Int[Array, "*episodes {steps}"]:
    """Sample K of the steps 0..T-1 of each episode, without replacement. If T < K, return all of them, and copies of the last one.

    Floyd's algorithm (Bentley and Floyd, 1987): for j = T-K .. T-1 take a uniform t of 0..j, or j if t was sampled before. It costs
    O(K^2) on K numbers, whatever T is, for all episodes at once.
    """
    uniform = jax.random.uniform(key, (steps, *length.shape))

    def body(chosen: Int[Array, "*episodes K"], sample: tuple[Int[Scalar, ""], Float[Array, "*episodes"]]):
        i, u = sample
        j = length - steps + i
        t = jnp.minimum(jnp.floor(u * (j + 1)).astype(jnp.int32), j)
        t = jnp.where(jnp.any(chosen == t[..., None], axis=-1), j, t)
        return chosen.at[..., i].set(t), None

    empty = jnp.full((*length.shape, steps), -1, jnp.int32)
    distinct, _ = jax.lax.scan(body, empty, (jnp.arange(steps), uniform))
    all_steps = jnp.minimum(jnp.arange(steps), length[..., None] - 1)
    return jnp.where((length >= steps)[..., None], distinct, all_steps)
