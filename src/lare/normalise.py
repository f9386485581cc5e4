"""Running statistics, kept in the training state, that let features and returns of any scale train alike."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

CLIP = 10.0
"""Normalised features are cut off at this many standard deviations."""


class Moments(NamedTuple):
    """Mean and spread of everything seen so far, one of each per feature."""

    seen: Float[Array, ""]
    mean: Float[Array, " features"]
    squares: Float[Array, " features"]
    """Sum of the squared deviations from the mean."""


def no_moments(features: int) -> Moments:
    return Moments(jnp.zeros(()), jnp.zeros(features), jnp.zeros(features))


def observe(moments: Moments, rows: Float[Array, "batch features"]) -> Moments:
    """Take a batch in (the parallel update of Chan, Golub and LeVeque, 1983: no catastrophic cancellation)."""
    count = moments.seen + rows.shape[0]
    mean = jnp.mean(rows, axis=0)
    gap = mean - moments.mean
    share = rows.shape[0] / count
    squares = moments.squares + jnp.sum((rows - mean) ** 2, axis=0) + gap**2 * moments.seen * share
    return Moments(count, moments.mean + gap * share, squares)


def deviation(moments: Moments) -> Float[Array, " features"]:
    """Standard deviations; 0 for a feature that never varied."""
    found = jnp.sqrt(moments.squares / jnp.maximum(moments.seen, 1))
    # A deviation within float32's rounding of the mean is noise, whatever its absolute size.
    return jnp.where(found > 1e-6 * jnp.abs(moments.mean), found, 0)


def standardise(moments: Moments, rows: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """(x - mean) / std, cut off at ±10. A feature that never varied becomes 0."""
    spread = deviation(moments)
    scaled = (rows - moments.mean) / jnp.where(spread > 0, spread, 1)
    return jnp.where(spread > 0, jnp.clip(scaled, -CLIP, CLIP), 0)


class Scale(NamedTuple):
    """Of what size the mean reward of an episode is, R/T."""

    seen: Float[Array, ""]
    mean_square: Float[Array, ""]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


def no_scale() -> Scale:
    return Scale(*(jnp.zeros(()) for _ in Scale._fields))


def observe_scale(scale: Scale, values: Float[Array, " batch"], counts: Bool[Array, " batch"]) -> Scale:
    """Take in those of `values` where `counts` is true."""
    count = scale.seen + jnp.sum(counts)
    excess = jnp.sum(jnp.where(counts, values**2 - scale.mean_square, 0))
    known = scale.seen > 0
    lowest = jnp.min(values, where=counts, initial=jnp.inf)
    highest = jnp.max(values, where=counts, initial=-jnp.inf)
    some = count > 0
    return Scale(
        count,
        scale.mean_square + excess / jnp.maximum(count, 1),
        jnp.where(some, jnp.where(known, jnp.minimum(scale.lowest, lowest), lowest), 0),
        jnp.where(some, jnp.where(known, jnp.maximum(scale.highest, highest), highest), 0),
    )


def within_range(scale: Scale, values: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """(x - lowest) / (highest - lowest); 0.5 as long as they are the same: which is good is not known."""
    width = scale.highest - scale.lowest
    return jnp.where(width > 0, (values - scale.lowest) / jnp.where(width > 0, width, 1), 0.5)


def magnitude(scale: Scale) -> Float[Array, ""]:
    """The scale, or 1 as long as every return was 0."""
    return jnp.where(scale.mean_square > 0, jnp.sqrt(scale.mean_square), 1)
