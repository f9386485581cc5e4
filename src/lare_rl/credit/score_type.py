"""How the score of an episode follows from its steps: a sum over them, an average, or a success whose odds they change."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.credit.prequential import Predictions, squared_errors

__all__ = [
    "ScoreType",
    "ScoreTypeEstimate",
    "compare_score_types",
    "is_better",
    "score_type_errors",
]

MAX_ERROR_RATIO = 0.95
"""Predictions of one type are better if their squared error is below this fraction of that of another type."""
MIN_Z = 2.0
"""The difference of the errors must also exceed this number of its standard errors. Otherwise a single episode could decide."""
ROUNDING = 1e-6
"""Squared errors below this fraction of the squared returns are treated as equal."""


class ScoreType(IntEnum):
    """How the score of an episode follows from its steps. Compiled functions take it as an integer."""

    SUM = 0
    """The score grows with the number of steps."""
    AVERAGE = 1
    """The score is an average or a grade, which does not grow with the number of steps."""
    LOG_ODDS = 2
    """The score has two values, and the log odds of the higher one are a sum over the steps (`logistic.py`)."""


class ScoreTypeEstimate(NamedTuple):
    """The type of a score, as estimated from the returns."""

    score_type: ScoreType
    is_certain: bool
    """Whether this type predicts the returns clearly better than its rival."""
    rival: ScoreType
    """The other type that predicts them best."""


def is_better(predictions: Predictions, index: int, rival: int) -> Bool[Array, ""]:
    """Return whether the decoder at `index` predicts returns with a smaller squared error than the one at `rival`, beyond chance."""
    returns, valid = predictions.returns, predictions.valid
    error, rival_error = (
        jnp.where(valid, (returns - predictions.predicted[:, i]) ** 2 + ROUNDING * returns**2, 0)
        for i in (index, rival)
    )
    n, difference = jnp.sum(valid), rival_error - error
    mean = jnp.sum(difference) / jnp.maximum(n, 1)
    variance = jnp.sum(jnp.where(valid, (difference - mean) ** 2, 0)) / jnp.maximum(n - 1, 1)
    is_beyond_chance = (n > 1) & (mean > MIN_Z * jnp.sqrt(variance / jnp.maximum(n, 1)))
    return is_beyond_chance & (jnp.sum(error) < MAX_ERROR_RATIO * jnp.sum(rival_error))


@jax.jit
def score_type_errors(predictions: Predictions) -> Float[Array, " score_types"]:
    """Return the squared error of each type's predictions, plus a margin for rounding."""
    return squared_errors(predictions) + ROUNDING * jnp.sum(predictions.returns**2)


def compare_score_types(predictions: Predictions, score_types: tuple[ScoreType, ...], index: int) -> ScoreTypeEstimate:
    """Compare the score type at `index`, which is used, with the others by their predictions of returns."""
    errors = np.array(score_type_errors(predictions))
    errors[index] = np.inf
    rival = int(np.argmin(errors))
    return ScoreTypeEstimate(score_types[index], bool(is_better(predictions, index, rival)), score_types[rival])
