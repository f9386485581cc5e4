"""Replay of whole episodes of one length and many agents, for the decoder: the newest ones, drawn uniformly.

Only what the method's encoder gives is kept, and the true rewards, for returns and to measure credit by. Everything here
is for one seed; callers `vmap`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

ROWS = ("features", "reward")
"""Fields that a checkpoint saves by row."""


class EpisodeReplay(NamedTuple):
    """Episodes of one seed, numbered from 0 for ever and stored at their number modulo the capacity."""

    features: Float[Array, "rows steps agents features"]
    reward: Float[Array, "rows steps agents"]
    """True."""
    next_row: Int[Scalar, ""]
    """Episodes ever stored."""


def empty(capacity: int, steps: int, agents: int, features: int) -> EpisodeReplay:
    return EpisodeReplay(
        jnp.zeros((capacity, steps, agents, features)), jnp.zeros((capacity, steps, agents)), jnp.zeros((), jnp.int32)
    )


def extend(
    held: EpisodeReplay,
    features: Float[Array, "episodes steps agents features"],
    reward: Float[Array, "episodes steps agents"],
) -> EpisodeReplay:
    """Add episodes; when there is no more room, the oldest go."""
    where = (held.next_row + jnp.arange(len(reward))) % len(held.reward)
    return EpisodeReplay(
        held.features.at[where].set(features), held.reward.at[where].set(reward), held.next_row + len(reward)
    )


def draw(held: EpisodeReplay, key: PRNGKeyArray, shape: tuple[int, ...]) -> Int[Array, "..."]:
    """Where some of the stored episodes stand, uniform, with replacement."""
    return jax.random.randint(key, shape, 0, jnp.clip(held.next_row, 1, len(held.reward)))


def newest(held: EpisodeReplay, count: int) -> Int[Array, " {count}"]:
    """Where the newest episodes stand; `count` is at most the capacity, and no more than have ever been stored."""
    return (held.next_row - 1 - jnp.arange(count)) % len(held.reward)
