"""How well returns are predicted before anything is fitted to them.

    R^2 = 1 - sum_k (R_k - R_hat_k)^2 / sum_k (R_k - mean R)^2
    gain = 1 - sum_k (R_k - R_hat_k)^2 / sum_k (R_k - m_k)^2

The sums run over the last episodes. R_hat_k is the sum of the proxy rewards that the decoder gave to the steps of episode k before it
was fitted to R_k. R^2 needs no true rewards of steps: if the environment pays only at the end, it is the only measure of the quality
of proxy rewards. If it is below 0, the mean return predicts better than the decoder.

m_k is the mean return of the other episodes of the same level. The gain with its standard error says whether the steps explain more
than the level. If a score is won or lost, chance remains, however good the credit is: a small gain may then be all there is to
explain, and only its standard error tells whether there is any.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.util.statistics import CONSTANT

__all__ = [
    "LITTLE_R2",
    "MIN_R2_EPISODES",
    "RETURN_TOLERANCE",
    "SEGMENT_WINDOW",
    "WINDOW",
    "Predictions",
    "add_predictions",
    "empty_predictions",
    "gain",
    "metrics",
    "r2",
    "ring_slots",
    "squared_errors",
]

WINDOW = 32
"""R^2 is computed over this number of last episodes."""
SEGMENT_WINDOW = 256
"""The same for payments, if there are several in an episode, and for scores that are won or lost."""
MIN_R2_EPISODES = 8
"""With fewer episodes, R^2 is NaN."""
RETURN_TOLERANCE = 1e-5
"""Returns that differ by less than this part of the larger one are equal. A return is stored as the mean reward of a step, so equal returns
of unlike lengths differ in their last digits."""
LITTLE_R2 = 0.1
"""Proxy rewards, or factors, explain next to nothing of the score if R^2 of the returns is lower."""


class Predictions(NamedTuple):
    """Returns of the last episodes, in no particular order, and their predictions by one or more decoders."""

    n_episodes: Float[Array, ""]
    """The number of episodes that were ever predicted."""
    returns: Float[Array, " window"]
    predicted: Float[Array, "window decoders"]
    level: Int[Array, " window"]
    """The level of each episode; 0 if levels make no difference."""

    @property
    def valid(self) -> Bool[Array, " window"]:
        """Which slots have an episode."""
        return jnp.arange(len(self.returns)) < self.n_episodes


def empty_predictions(n_decoders: int, window: int = WINDOW) -> Predictions:
    """Return the state before the first prediction."""
    return Predictions(jnp.zeros(()), jnp.zeros(window), jnp.zeros((window, n_decoders)), jnp.zeros(window, jnp.int32))


def add_predictions(
    predictions: Predictions,
    returns: Float[Array, " episodes"],
    predicted: Float[Array, "episodes decoders"],
    mask: Bool[Array, " episodes"],
    level: Int[Array, " episodes"] | None,
) -> Predictions:
    """Add new episodes, at most as many as the window has. Episodes where `mask` is false are ignored.

    `level` is None if levels make no difference.
    """
    slot = ring_slots(predictions.n_episodes, mask, len(predictions.returns))
    return Predictions(
        predictions.n_episodes + jnp.sum(mask),
        predictions.returns.at[slot].set(returns.astype(jnp.float32), mode="drop"),
        predictions.predicted.at[slot].set(predicted.astype(jnp.float32), mode="drop"),
        predictions.level if level is None else predictions.level.at[slot].set(level.astype(jnp.int32), mode="drop"),
    )


def ring_slots(n_before: Float[Array, ""], mask: Bool[Array, " episodes"], window: int) -> Int[Array, " episodes"]:
    """Return where new episodes are stored in a window of the last ones.

    Episodes where `mask` is false get an index out of bounds, which `mode="drop"` drops.
    """
    return jnp.where(mask, (n_before.astype(jnp.int32) + jnp.cumsum(mask) - 1) % window, window)


def squared_errors(predictions: Predictions) -> Float[Array, " decoders"]:
    """Return sum_k (R_k - R_hat_k)^2 of each decoder."""
    errors = (predictions.returns[:, None] - predictions.predicted) ** 2
    return jnp.sum(jnp.where(predictions.valid[:, None], errors, 0), axis=0)


def r2(predictions: Predictions) -> Float[Array, " decoders"]:
    """Return R^2 of each decoder, or NaN if there are too few episodes or all returns are equal."""
    valid, count = predictions.valid, jnp.sum(predictions.valid)
    mean = jnp.sum(jnp.where(valid, predictions.returns, 0)) / jnp.maximum(count, 1)
    total = jnp.sum(jnp.where(valid, (predictions.returns - mean) ** 2, 0))
    is_defined = (count >= MIN_R2_EPISODES) & (total > CONSTANT * count * mean**2)
    return jnp.where(is_defined, 1 - squared_errors(predictions) / jnp.where(is_defined, total, 1), jnp.nan)


def metrics(predictions: Predictions) -> dict[str, Float[Array, ""]]:
    """Return R^2 and the gain of the first decoder, under the keys of metrics.jsonl."""
    ratio, error = gain(predictions)
    return {"credit/return_r2": r2(predictions)[0], "credit/gain": ratio, "credit/gain_error": error}


def gain(predictions: Predictions) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the gain of the first decoder, and its standard error over episodes. Both are NaN if R^2 is.

    The standard error is that of a ratio of means, as in `statistics.ratio_of_sums`. An episode that is alone in its level is compared
    with all other episodes.
    """
    valid = predictions.valid
    different = valid[None] & ~jnp.eye(len(valid), dtype=bool)
    same = different & (predictions.level[:, None] == predictions.level[None])
    peers = jnp.where(jnp.any(same, axis=1, keepdims=True), same, different).astype(jnp.float32)
    mean = peers @ predictions.returns / jnp.maximum(jnp.sum(peers, axis=1), 1)
    error = jnp.where(valid, (predictions.returns - predictions.predicted[:, 0]) ** 2, 0)
    baseline = jnp.where(valid, (predictions.returns - mean) ** 2, 0)
    total = jnp.sum(baseline)
    is_defined = jnp.isfinite(r2(predictions)[0]) & (total > 0)
    ratio = 1 - jnp.sum(error) / jnp.where(is_defined, total, 1)
    n, squares = jnp.sum(valid), jnp.sum((baseline - error - ratio * baseline) ** 2)
    std_error = jnp.sqrt(n / jnp.maximum(n - 1, 1) * squares) / jnp.where(is_defined, total, 1)
    return jnp.where(is_defined, ratio, jnp.nan), jnp.where(is_defined, std_error, jnp.nan)
