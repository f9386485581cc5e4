"""How the score of an episode follows from its steps: a sum over them, or a mean."""

from enum import IntEnum
from typing import NamedTuple

__all__ = ["ScoreType", "ScoreTypeEstimate", "score_types_to_fit"]


class ScoreType(IntEnum):
    """How the score of an episode follows from its steps. Compiled functions take it as an integer."""

    SUM = 0
    """The score grows with the number of steps."""
    MEAN = 1
    """The score is a mean or a grade, which does not grow with the number of steps."""


class ScoreTypeEstimate(NamedTuple):
    """The type of a score, as estimated from the returns."""

    score_type: ScoreType
    is_certain: bool
    """Whether this type predicts the returns clearly better than the other one."""


def score_types_to_fit(score: str, fixed_length: bool) -> tuple[ScoreType, ...]:
    """Return the types to fit, by the setting `score`: both if it is "auto" and episodes differ in length, else one."""
    if score == "auto":
        return (ScoreType.SUM,) if fixed_length else (ScoreType.SUM, ScoreType.MEAN)
    return (ScoreType.SUM,) if score == "sum" else (ScoreType.MEAN,)
