"""How the score of an episode follows from its steps: a sum over them, an average, or a success whose odds they change."""

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

__all__ = [
    "MAX_ERROR_RATIO",
    "ROUNDING",
    "ScoreType",
    "ScoreTypeEstimate",
    "compare_score_types",
    "is_better",
    "score_types_to_fit",
]

MAX_ERROR_RATIO = 0.95
"""Predictions of one type are better if their squared error is below this fraction of that of another type. If all episodes are equally
long, both errors are equal except for rounding."""
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


def score_types_to_fit(score: str, fixed_length: bool, *, allow_log_odds: bool) -> tuple[ScoreType, ...]:
    """Return the types to fit, in the order of their values.

    Args:
        score: the setting of this name.
        fixed_length: whether all episodes have the same length. A sum and an average are then the same.
        allow_log_odds: whether a score may be log odds. Decoders that are fitted in closed form allow it.
    """
    if score in ("sum", "average"):
        return (ScoreType.SUM,) if score == "sum" else (ScoreType.AVERAGE,)
    linear = (ScoreType.SUM,) if fixed_length else (ScoreType.SUM, ScoreType.AVERAGE)
    return (*linear, ScoreType.LOG_ODDS) if score == "binary" and allow_log_odds else linear


def is_better(
    returns: Float[Array, " episodes"],
    predicted: Float[Array, " episodes"],
    rival: Float[Array, " episodes"],
    valid: Bool[Array, " episodes"],
) -> Bool[Array, ""]:
    """Return whether `predicted` is closer to the returns than `rival` in the mean of the squared error, beyond chance."""
    rounding = ROUNDING * returns**2
    error, rival_error = (jnp.where(valid, (returns - x) ** 2 + rounding, 0) for x in (predicted, rival))
    n, difference = jnp.sum(valid), rival_error - error
    mean = jnp.sum(difference) / jnp.maximum(n, 1)
    variance = jnp.sum(jnp.where(valid, (difference - mean) ** 2, 0)) / jnp.maximum(n - 1, 1)
    is_beyond_chance = (n > 1) & (mean > MIN_Z * jnp.sqrt(variance / jnp.maximum(n, 1)))
    return is_beyond_chance & (jnp.sum(error) < MAX_ERROR_RATIO * jnp.sum(rival_error))


def compare_score_types(errors: Mapping[ScoreType, float], chosen: ScoreType) -> ScoreTypeEstimate:
    """Compare the chosen type with the others, by the squared error of each type's predictions of returns."""
    rival = min((other for other in errors if other != chosen), key=lambda other: errors[other])
    return ScoreTypeEstimate(chosen, errors[chosen] < MAX_ERROR_RATIO * errors[rival], rival)
