"""How the steps of several episodes are laid out in the rows of one batch.

Lengths 3, 2 and 4, packed into 8 rows (the third episode does not fit) or padded to 4 rows each ("-" is padding):

    packed   episode_index  0 0 0  1 1  - - -        padded   episode_index  0 0 0 0  1 1 1 1  2 2 2 2
             step           0 1 2  0 1  - - -                 step           0 1 2 2  0 1 1 1  0 1 2 3

The functions that lay steps out work on arrays of NumPy and of JAX.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

__all__ = ["Layout", "lay_out_packed", "lay_out_padded", "lay_out_sampled", "locate", "sample_step_numbers"]


class Layout(NamedTuple):
    """The episode and the step of each row. Both arrays are of NumPy or both of JAX.

    They have the shape [rows] if episodes are packed, else [*batch episodes rows].
    """

    episode_index: Any
    """The index of the row's episode in the batch; for padding, the number of episodes."""
    step: Any
    """The number of the step in its episode."""


def lay_out_packed(length: Any, mask: Any, rows: int) -> tuple[Layout, Any]:
    """Put whole episodes one after the other.

    Args:
        length: [episodes] the number of steps of each episode.
        mask: [episodes] 0 for an episode that is not part of the batch.
        rows: the number of rows. An episode that does not fit, and all after it, are left out.

    Returns:
        The layout, and the mask of the episodes that fit.
    """
    xp = length.__array_namespace__()
    length = xp.where(mask > 0, length, 0)  # the sum over all episodes may exceed 32 bits
    mask = mask * (xp.cumsum(length) <= rows)
    index, step = locate(length, xp.arange(rows))
    is_step = (mask[index] > 0) & (step < length[index])
    return Layout(xp.where(is_step, index, len(length)), xp.where(is_step, step, 0)), mask


def locate(count: Any, position: Any) -> tuple[Any, Any]:
    """Return the group and the number in it of the items at some positions. All groups are in a row, one after the other.

    Args:
        count: [groups] the number of items of each group.
        position: [*batch], from 0 on.
    """
    xp = count.__array_namespace__()
    end = xp.cumsum(count)
    group = xp.minimum(xp.searchsorted(end, position, side="right"), len(count) - 1)
    return group, position - (end - count)[group]


def lay_out_padded(length: Any, rows_per_episode: int) -> Layout:
    """Give each episode the same number of rows. Its last step is repeated in the rows that are left over.

    Args:
        length: [*batch episodes] the number of steps of each episode.
        rows_per_episode: at least the largest length.

    Returns:
        Arrays of shape [*batch episodes rows_per_episode].
    """
    xp = length.__array_namespace__()
    step = xp.minimum(xp.arange(rows_per_episode), length[..., None] - 1)
    return Layout(xp.broadcast_to(xp.arange(length.shape[-1])[:, None], step.shape), step)


def lay_out_sampled(length: Any, step: Any) -> Layout:
    """Use K steps of each episode. If it has only T < K, its last K - T rows are padding.

    Args:
        length: [*batch episodes] the number of steps of each episode.
        step: [*batch episodes K] from `sample_step_numbers`.

    Returns:
        Arrays of shape [*batch episodes K].
    """
    xp = length.__array_namespace__()
    count = length.shape[-1]
    is_step = xp.arange(step.shape[-1]) < length[..., None]
    return Layout(xp.where(is_step, xp.arange(count)[:, None], count), step)


def sample_step_numbers(
    key: PRNGKeyArray, length: Int[Array, "*episodes"], steps: int
) -> Int[Array, "*episodes {steps}"]:
    """Sample K of the steps 0..T-1 of each episode, without replacement. If T < K, return all of them, and copies of the last one.

    Floyd's algorithm (Bentley and Floyd, 1987): for j = T-K .. T-1 take a uniform t of 0..j, or j if t was sampled before. It costs
    O(K^2) for each episode, whatever T is, and all episodes are sampled at once.
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
