"""Running statistics, by which features and returns are normalised."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lare_rl.util.statistics import FLOAT32_NOISE

__all__ = [
    "CLIP",
    "RunningMeanStd",
    "Scale",
    "empty_mean_std",
    "empty_scale",
    "merge_means",
    "min_max_scale",
    "root_mean_square",
    "running_std",
    "standardise",
    "standardise_unless_empty",
    "update_mean_std",
    "update_scale",
]

CLIP = 10.0
"""Standardised features are clipped to this many standard deviations."""


class RunningMeanStd(NamedTuple):
    """Statistics of all rows so far, from which the mean and the standard deviation of each feature follow."""

    n_rows: Float[Array, ""]
    mean: Float[Array, "*features"]
    sum_squares: Float[Array, "*features"]
    """The sum of the squared deviations from the mean."""


def empty_mean_std(n_features: int) -> RunningMeanStd:
    """Return the statistics of no rows."""
    return RunningMeanStd(jnp.zeros(()), jnp.zeros(n_features), jnp.zeros(n_features))


def update_mean_std(
    statistics: RunningMeanStd, rows: Float[Array, "*batch features"], mask: Bool[Array, "*batch"] | None = None
) -> RunningMeanStd:
    """Add a batch of rows. Rows where `mask` is false are ignored."""
    rows = rows.reshape(math.prod(rows.shape[:-1]), rows.shape[-1])
    mask = None if mask is None else mask.ravel()
    n_new, where = (len(rows), None) if mask is None else (jnp.sum(mask), mask[:, None])
    mean = jnp.sum(rows, axis=0, where=where) / jnp.maximum(n_new, 1)
    batch_squares = jnp.sum((rows - mean) ** 2, axis=0, where=where)
    n_rows, merged, between = merge_means(statistics.n_rows, statistics.mean, n_new, mean)
    return RunningMeanStd(n_rows, merged, statistics.sum_squares + batch_squares + between)


def merge_means(n: Any, mean: Any, n_new: Any, new_mean: Any, square: Any = lambda d: d**2) -> tuple[Any, Any, Any]:
    """Merge the mean of `n` old rows and that of `n_new` new rows.

    Return the number of all rows, their mean, and `between` = d^2 n n_new / (n + n_new), where d is the difference of the two means. With S
    the sum of squared deviations of some rows from their own mean:

        S of all rows = S of the old rows + S of the new rows + between

    Means have the shape (features,), and so has `between`. With `square=lambda d: jnp.outer(d, d)` it is (features, features), for sums of
    products of deviations. The parallel update of Chan, Golub and LeVeque (1983), which avoids catastrophic cancellation.
    """
    n_all, difference = n + n_new, new_mean - mean
    fraction = n_new / jnp.maximum(n_all, 1)
    return n_all, mean + fraction * difference, square(difference) * n * fraction


def running_std(statistics: RunningMeanStd) -> Float[Array, "*features"]:
    """Return the standard deviation of each feature. The variance is divided by n, not by n - 1.

    A deviation of at most `FLOAT32_NOISE` of the mean may be rounding in float32, and counts as 0.
    """
    std = jnp.sqrt(statistics.sum_squares / jnp.maximum(statistics.n_rows, 1))
    return jnp.where(std > FLOAT32_NOISE * jnp.abs(statistics.mean), std, 0)


def standardise(statistics: RunningMeanStd, rows: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Return (x - mean) / std, clipped to ±`CLIP`. A feature without variation (`running_std`) becomes 0."""
    std = running_std(statistics)
    scaled = (rows - statistics.mean) / jnp.where(std > 0, std, 1)
    return jnp.where(std > 0, jnp.clip(scaled, -CLIP, CLIP), 0)


def standardise_unless_empty(
    statistics: RunningMeanStd, rows: Float[Array, "*batch features"]
) -> Float[Array, "*batch features"]:
    """Return standardised rows, or the rows unchanged while the statistics are empty."""
    return jnp.where(statistics.n_rows > 0, standardise(statistics, rows), rows)


class Scale(NamedTuple):
    """Count, mean square, minimum and maximum of a number that each episode has, such as its mean reward R/T."""

    n_episodes: Float[Array, ""]
    mean_square: Float[Array, ""]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


def empty_scale() -> Scale:
    """Return the scale before the first episode."""
    return Scale(*(jnp.zeros(()) for _ in Scale._fields))


def update_scale(scale: Scale, values: Float[Array, " batch"], mask: Bool[Array, " batch"]) -> Scale:
    """Add the values where `mask` is true."""
    n_episodes = scale.n_episodes + jnp.sum(mask)
    square_differences = jnp.sum(jnp.where(mask, values**2 - scale.mean_square, 0))
    was_empty, is_empty = scale.n_episodes == 0, n_episodes == 0
    lowest = jnp.min(values, where=mask, initial=jnp.where(was_empty, jnp.inf, scale.lowest))
    highest = jnp.max(values, where=mask, initial=jnp.where(was_empty, -jnp.inf, scale.highest))
    return Scale(
        n_episodes=n_episodes,
        mean_square=scale.mean_square + square_differences / jnp.maximum(n_episodes, 1),
        lowest=jnp.where(is_empty, 0, lowest),
        highest=jnp.where(is_empty, 0, highest),
    )


def min_max_scale(scale: Scale, values: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return (x - lowest) / (highest - lowest), or 0.5 while lowest and highest are the same. Values outside this range are not clipped."""
    width = scale.highest - scale.lowest
    return jnp.where(width > 0, (values - scale.lowest) / jnp.where(width > 0, width, 1), 0.5)


def root_mean_square(scale: Scale) -> Float[Array, ""]:
    """Return the root mean square of the values, or 1 while their squares are 0."""
    return jnp.where(scale.mean_square > 0, jnp.sqrt(scale.mean_square), 1)
