"""Running statistics, kept in the training state, so that the scale of features and returns does not matter."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

CLIP = 10.0
"""Normalised features are clipped to this many standard deviations."""


class RunningMeanStd(NamedTuple):
    """Mean and spread of each feature over all rows so far."""

    rows: Float[Array, ""]
    """The number of rows."""
    mean: Float[Array, " features"]
    squares: Float[Array, " features"]
    """Sum of the squared deviations from the mean."""


def new_mean_std(features: int) -> RunningMeanStd:
    """Empty statistics."""
    return RunningMeanStd(jnp.zeros(()), jnp.zeros(features), jnp.zeros(features))


def observe(
    statistics: RunningMeanStd, rows: Float[Array, "batch features"], mask: Bool[Array, " batch"] | None = None
) -> RunningMeanStd:
    """Add a batch (the parallel update of Chan, Golub and LeVeque, 1983: no catastrophic cancellation).

    Rows where `mask` is false are ignored.
    """
    if mask is None:
        added, mean = rows.shape[0], jnp.mean(rows, axis=0)
        spread = jnp.sum((rows - mean) ** 2, axis=0)
    else:
        added, mean = jnp.sum(mask), jnp.sum(rows, axis=0, where=mask[:, None]) / jnp.maximum(jnp.sum(mask), 1)
        spread = jnp.sum((rows - mean) ** 2, axis=0, where=mask[:, None])
    count = statistics.rows + added
    gap = mean - statistics.mean
    share = added / jnp.maximum(count, 1)
    squares = statistics.squares + spread + gap**2 * statistics.rows * share
    return RunningMeanStd(count, statistics.mean + gap * share, squares)


def deviation(statistics: RunningMeanStd) -> Float[Array, " features"]:
    """Standard deviations; 0 for a feature that never varied."""
    found = jnp.sqrt(statistics.squares / jnp.maximum(statistics.rows, 1))
    # A deviation within float32's rounding of the mean is noise, whatever its absolute size.
    return jnp.where(found > 1e-6 * jnp.abs(statistics.mean), found, 0)


def standardise(statistics: RunningMeanStd, rows: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """(x - mean) / std, clipped to ±10. A feature that never varied becomes 0."""
    spread = deviation(statistics)
    scaled = (rows - statistics.mean) / jnp.where(spread > 0, spread, 1)
    return jnp.where(spread > 0, jnp.clip(scaled, -CLIP, CLIP), 0)


def standardise_if_known(
    statistics: RunningMeanStd, rows: Float[Array, "*batch features"]
) -> Float[Array, "*batch features"]:
    """Like `standardise`, but the rows are unchanged while the statistics are empty."""
    return jnp.where(statistics.rows > 0, standardise(statistics, rows), rows)


class Scale(NamedTuple):
    """The scale of an episode's mean reward, R/T."""

    episodes: Float[Array, ""]
    """The number of episodes."""
    mean_square: Float[Array, ""]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


def new_scale() -> Scale:
    """An empty scale."""
    return Scale(*(jnp.zeros(()) for _ in Scale._fields))


def observe_scale(scale: Scale, values: Float[Array, " batch"], mask: Bool[Array, " batch"]) -> Scale:
    """Add the values where `mask` is true."""
    count = scale.episodes + jnp.sum(mask)
    excess = jnp.sum(jnp.where(mask, values**2 - scale.mean_square, 0))
    known = scale.episodes > 0
    lowest = jnp.min(values, where=mask, initial=jnp.inf)
    highest = jnp.max(values, where=mask, initial=-jnp.inf)
    some = count > 0
    return Scale(
        count,
        scale.mean_square + excess / jnp.maximum(count, 1),
        jnp.where(some, jnp.where(known, jnp.minimum(scale.lowest, lowest), lowest), 0),
        jnp.where(some, jnp.where(known, jnp.maximum(scale.highest, highest), highest), 0),
    )


def within_range(scale: Scale, values: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """(x - lowest) / (highest - lowest); 0.5 while lowest and highest are the same."""
    width = scale.highest - scale.lowest
    return jnp.where(width > 0, (values - scale.lowest) / jnp.where(width > 0, width, 1), 0.5)


def magnitude(scale: Scale) -> Float[Array, ""]:
    """The root mean square of R/T, or 1 while every return is 0."""
    return jnp.where(scale.mean_square > 0, jnp.sqrt(scale.mean_square), 1)
