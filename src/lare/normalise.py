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
    """Root mean square of the mean reward of an episode, R/T."""

    seen: Float[Array, ""]
    mean_square: Float[Array, ""]


def no_scale() -> Scale:
    return Scale(jnp.zeros(()), jnp.zeros(()))


def observe_scale(scale: Scale, values: Float[Array, " batch"], counts: Bool[Array, " batch"]) -> Scale:
    """Take in those of `values` where `counts` is true."""
    count = scale.seen + jnp.sum(counts)
    excess = jnp.sum(jnp.where(counts, values**2 - scale.mean_square, 0))
    return Scale(count, scale.mean_square + excess / jnp.maximum(count, 1))


def magnitude(scale: Scale) -> Float[Array, ""]:
    """The scale, or 1 as long as every return was 0."""
    return jnp.where(scale.mean_square > 0, jnp.sqrt(scale.mean_square), 1)
