"""Means of R/T by level, for decoders that are fitted by gradient descent.

Episodes may belong to levels, which differ in difficulty. A decoder is then fitted to R/T less the offset of the episode's level,

    d_g = s_g (mean_g - mean),    s_g = between / (between + within / n_g)

with mean_g the mean of R/T over the n_g episodes of level g, mean = sum_g n_g mean_g / sum_g n_g, and the variances within and
between levels by the method of moments.
The factor s_g shrinks the means of levels with few episodes (random effects: Searle, Casella and McCulloch, 1992).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.nn.normalise import merge_means

__all__ = ["LevelStatistics", "add_mean_rewards", "empty_level_statistics", "level_offsets"]


class LevelStatistics(NamedTuple):
    """The number, the mean and the sum of squared deviations of R/T in each level."""

    n_episodes: Float[Array, " levels"]
    mean: Float[Array, " levels"]
    sum_squares: Float[Array, " levels"]


def empty_level_statistics(n_levels: int) -> LevelStatistics:
    """Return the state before the first episode."""
    return LevelStatistics(*(jnp.zeros(n_levels) for _ in LevelStatistics._fields))


def add_mean_rewards(
    statistics: LevelStatistics,
    level: Int[Array, " batch"],
    mean_reward: Float[Array, " batch"],
    mask: Bool[Array, " batch"],
) -> LevelStatistics:
    """Add the episodes where `mask` is true."""
    n_levels = len(statistics.mean)
    slot = jnp.where(mask, level, n_levels)  # an index out of range, which is dropped

    def sums(values: Float[Array, " batch"]) -> Float[Array, " levels"]:
        return jnp.zeros(n_levels).at[slot].add(values, mode="drop")

    n_new = sums(jnp.ones_like(mean_reward))
    mean = sums(mean_reward) / jnp.maximum(n_new, 1)
    squares = sums((mean_reward - mean[jnp.minimum(slot, n_levels - 1)]) ** 2)
    n_episodes, merged, between = merge_means(statistics.n_episodes, statistics.mean, n_new, mean)
    return LevelStatistics(n_episodes, merged, statistics.sum_squares + squares + between)


def level_offsets(statistics: LevelStatistics) -> Float[Array, " levels"]:
    """Return d_g of each level: 0 for a level without episodes, and for all while there is one level or none has two episodes."""
    n, total = statistics.n_episodes, jnp.sum(statistics.n_episodes)
    n_observed = jnp.sum(n > 0)
    mean = jnp.sum(n * statistics.mean) / jnp.maximum(total, 1)
    within = jnp.sum(statistics.sum_squares) / jnp.maximum(total - n_observed, 1)
    # k - 1 times the mean number of episodes of k levels, in the method of moments for levels of different size.
    size = jnp.maximum(total - jnp.sum(n**2) / jnp.maximum(total, 1), 1e-6)
    between = jnp.maximum(jnp.sum(n * (statistics.mean - mean) ** 2) - (n_observed - 1) * within, 0) / size
    shrinkage = between / jnp.maximum(between + within / jnp.maximum(n, 1), 1e-30)
    is_known = (n > 0) & (n_observed > 1) & (total > n_observed)
    return jnp.where(is_known, shrinkage * (statistics.mean - mean), 0)
