"""Estimates with 95% intervals, by the stratified bootstrap of rliable (Agarwal et al., "Deep RL at the edge of the statistical
precipice", NeurIPS 2021).
"""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lare_rl.errors import missing_extra_error
from lare_rl.util.statistics import Band, format_rounded

__all__ = [
    "REPETITIONS",
    "Estimate",
    "OtherScores",
    "Scores",
    "bootstrap",
    "bootstrap_band",
    "interquartile_means",
    "load_rliable",
    "probability_of_improvement",
]

REPETITIONS = 2000
"""Number of bootstrap samples."""

Scores = Float[np.ndarray, "runs tasks *steps"]
OtherScores = Float[np.ndarray, "other_runs tasks *steps"]


@dataclass(frozen=True)
class Estimate:
    """A number and its 95% interval. The interval has no width if there is only one run to sample from."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if self.low == self.high:
            return format_rounded(self.value, 0.0)
        texts = (format_rounded(number, self.high - self.low) for number in (self.value, self.low, self.high))
        return "{} [{}, {}]".format(*texts)


def bootstrap(
    scores: Scores | tuple[Scores, OtherScores], function: Callable[..., Float[np.ndarray, "*values"]]
) -> list[Estimate]:
    """Estimate the values of a function of scores, with intervals by resampling the runs of each task.

    If there are two arrays of scores, the function takes both, and the runs of each are resampled. The random numbers are always
    the same.
    """
    library = load_rliable()
    with warnings.catch_warnings(), _seeded_numpy(0):
        warnings.simplefilter("ignore")  # rliable's dependencies warn about each other
        points, intervals = library.get_interval_estimates({"": scores}, function, reps=REPETITIONS)
    values, (low, high) = np.atleast_1d(points[""]), np.reshape(intervals[""], (2, -1))
    return [Estimate(*map(float, numbers)) for numbers in zip(values, low, high, strict=True)]


def bootstrap_band(
    x: Float[np.ndarray, " points"], scores: Scores, function: Callable[..., Float[np.ndarray, " points"]]
) -> Band:
    """Estimate the curve of a function of scores."""
    curve = bootstrap(scores, function)
    return Band(
        x=x,
        value=np.array([estimate.value for estimate in curve]),
        low=np.array([estimate.low for estimate in curve]),
        high=np.array([estimate.high for estimate in curve]),
    )


# A bootstrap calls these functions thousands of times, and the checks of the same functions in rliable take most of their time.


def interquartile_means(scores: Scores) -> Float[np.ndarray, " steps"]:
    """Return the mean of the middle half of all runs and tasks, at every step: `aggregate_iqm` of rliable."""
    ascending = np.sort(scores.reshape(-1, scores.shape[-1]), axis=0)
    cut = len(ascending) // 4
    return ascending[cut : len(ascending) - cut].mean(axis=0)


def probability_of_improvement(scores: Scores, baseline: OtherScores) -> float:
    """Return the share of pairs of runs on a task in which the run scores more than the baseline. A tie counts half."""
    return float(np.mean((scores[:, None] > baseline) + 0.5 * (scores[:, None] == baseline)))


def load_rliable() -> Any:
    """Import the library. Raises `LareError` if it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from rliable import library
    except ImportError:
        raise missing_extra_error("a comparison", "statistics") from None
    return library


@contextlib.contextmanager
def _seeded_numpy(seed: int) -> Iterator[None]:
    """Seed NumPy's global random numbers for a while. Rliable draws from them even if it is given a random state."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)
