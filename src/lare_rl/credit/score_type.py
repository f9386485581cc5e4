"""How the score of an episode follows from its steps: a sum over them, an average, or a success whose odds they change."""

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

__all__ = [
    "MAX_ERROR_RATIO",
    "ROUNDING",
    "ScoreType",
    "ScoreTypeEstimate",
    "compare_score_types",
    "score_types_to_fit",
]

MAX_ERROR_RATIO = 0.95
"""A score is treated as an average if its predictions as an average have a squared error below this fraction of the error as a sum. If all
episodes are equally long, both errors are equal except for rounding."""
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


def compare_score_types(errors: Mapping[ScoreType, float], chosen: ScoreType) -> ScoreTypeEstimate:
    """Compare the chosen type with the others, by the squared error of each type's predictions of returns."""
    rival = min((other for other in errors if other != chosen), key=lambda other: errors[other])
    return ScoreTypeEstimate(chosen, errors[chosen] < MAX_ERROR_RATIO * errors[rival], rival)
