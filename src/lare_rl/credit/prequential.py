"""How well returns are predicted before anything is fitted to them.

    R^2 = 1 - sum_k (R_k - R_hat_k)^2 / sum_k (R_k - mean R)^2

over the last episodes, where R_hat_k is the sum of the proxy rewards that the decoder gave to the steps of episode k before
it had seen R_k. R^2 needs no true rewards of steps: if the environment pays only at the end, it is the only measure of the
quality of proxy rewards. If it is below 0, the mean return predicts better than the decoder.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

LAST = 32
"""R^2 is computed over this many last episodes."""
FEWEST = 8
"""With fewer episodes, R^2 is NaN."""


class Predictions(NamedTuple):
    """Returns of the last episodes, in no particular order, and the predictions of one or more ways to predict."""

    episodes: Float[Array, ""]
    """The number of episodes that were ever predicted."""
    returns: Float[Array, " last"]
    predicted: Float[Array, "last ways"]


def no_predictions(ways: int) -> Predictions:
    """The state before the first prediction."""
    return Predictions(jnp.zeros(()), jnp.zeros(LAST), jnp.zeros((LAST, ways)))


def remember(
    before: Predictions,
    returns: Float[Array, " episodes"],
    predicted: Float[Array, "episodes ways"],
    mask: Bool[Array, " episodes"],
) -> Predictions:
    """Add new episodes, at most `LAST` of them. Episodes where `mask` is false are ignored."""
    place = (before.episodes.astype(jnp.int32) + jnp.cumsum(mask) - 1) % LAST
    place = jnp.where(mask, place, LAST)  # an index out of bounds, which is dropped
    return Predictions(
        before.episodes + jnp.sum(mask),
        before.returns.at[place].set(returns.astype(jnp.float32), mode="drop"),
        before.predicted.at[place].set(predicted.astype(jnp.float32), mode="drop"),
    )


def squared_errors(known: Predictions) -> Float[Array, " ways"]:
    """sum_k (R_k - R_hat_k)^2 of each way."""
    there = jnp.arange(LAST) < known.episodes
    return jnp.sum(jnp.where(there[:, None], (known.returns[:, None] - known.predicted) ** 2, 0), axis=0)


def r2(known: Predictions) -> Float[Array, " ways"]:
    """R^2 of each way; NaN if there are too few episodes or all returns are equal."""
    there = jnp.arange(LAST) < known.episodes
    count = jnp.sum(there)
    mean = jnp.sum(jnp.where(there, known.returns, 0)) / jnp.maximum(count, 1)
    spread = jnp.sum(jnp.where(there, (known.returns - mean) ** 2, 0))
    told = (count >= FEWEST) & (spread > 1e-10 * count * mean**2)
    return jnp.where(told, 1 - squared_errors(known) / jnp.where(told, spread, 1), jnp.nan)
