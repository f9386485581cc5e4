"""How well returns are predicted before anything is fitted to them.

    R^2 = 1 - sum_k (R_k - R_hat_k)^2 / sum_k (R_k - mean R)^2

The sums run over the last episodes. R_hat_k is the sum of the proxy rewards that the decoder gave to the steps of episode k before it
was fitted to R_k. R^2 needs no true rewards of steps: if the environment pays only at the end, it is the only measure of the quality
of proxy rewards. If it is below 0, the mean return predicts better than the decoder.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

__all__ = ["SEGMENT_WINDOW", "WINDOW", "Predictions", "add_predictions", "empty_predictions", "r2", "squared_errors"]

WINDOW = 32
"""R^2 is computed over this number of last episodes."""
SEGMENT_WINDOW = 256
"""The same for payments, if there are several in an episode."""
MIN_R2_EPISODES = 8
"""With fewer episodes, R^2 is NaN."""


class Predictions(NamedTuple):
    """Returns of the last episodes, in no particular order, and their predictions by one or more decoders."""

    n_episodes: Float[Array, ""]
    """The number of episodes that were ever predicted."""
    returns: Float[Array, " window"]
    predicted: Float[Array, "window decoders"]


def empty_predictions(n_decoders: int, window: int = WINDOW) -> Predictions:
    """Return the state before the first prediction."""
    return Predictions(jnp.zeros(()), jnp.zeros(window), jnp.zeros((window, n_decoders)))


def add_predictions(
    predictions: Predictions,
    returns: Float[Array, " episodes"],
    predicted: Float[Array, "episodes decoders"],
    mask: Bool[Array, " episodes"],
) -> Predictions:
    """Add new episodes, at most as many as the window has. Episodes where `mask` is false are ignored."""
    window = len(predictions.returns)
    slot = (predictions.n_episodes.astype(jnp.int32) + jnp.cumsum(mask) - 1) % window
    slot = jnp.where(mask, slot, window)  # an index out of bounds, which is dropped
    return Predictions(
        predictions.n_episodes + jnp.sum(mask),
        predictions.returns.at[slot].set(returns.astype(jnp.float32), mode="drop"),
        predictions.predicted.at[slot].set(predicted.astype(jnp.float32), mode="drop"),
    )


def squared_errors(predictions: Predictions) -> Float[Array, " decoders"]:
    """Return sum_k (R_k - R_hat_k)^2 of each decoder."""
    valid = jnp.arange(len(predictions.returns)) < predictions.n_episodes
    errors = (predictions.returns[:, None] - predictions.predicted) ** 2
    return jnp.sum(jnp.where(valid[:, None], errors, 0), axis=0)


def r2(predictions: Predictions) -> Float[Array, " decoders"]:
    """Return R^2 of each decoder, or NaN if there are too few episodes or all returns are equal."""
    valid = jnp.arange(len(predictions.returns)) < predictions.n_episodes
    count = jnp.sum(valid)
    mean = jnp.sum(jnp.where(valid, predictions.returns, 0)) / jnp.maximum(count, 1)
    total = jnp.sum(jnp.where(valid, (predictions.returns - mean) ** 2, 0))
    is_defined = (count >= MIN_R2_EPISODES) & (total > 1e-10 * count * mean**2)
    return jnp.where(is_defined, 1 - squared_errors(predictions) / jnp.where(is_defined, total, 1), jnp.nan)
