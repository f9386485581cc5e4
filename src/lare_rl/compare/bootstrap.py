"""Estimates with 95% intervals, by the stratified bootstrap of rliable (Agarwal et al., "Deep RL at the edge of the statistical
precipice", NeurIPS 2021), and the exact test of Mann and Whitney (1947).
"""

import contextlib
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
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
    "mann_whitney",
    "mann_whitney_u",
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
    return Band(x, *np.transpose([(estimate.value, estimate.low, estimate.high) for estimate in curve]))


# A bootstrap calls these functions thousands of times, and the checks of the same functions in rliable take most of their time.


def interquartile_means(scores: Scores) -> Float[np.ndarray, " steps"]:
    """Return the mean of the middle half of all runs and tasks, at every step: `aggregate_iqm` of rliable."""
    ascending = np.sort(scores.reshape(-1, scores.shape[-1]), axis=0)
    cut = len(ascending) // 4
    return ascending[cut : len(ascending) - cut].mean(axis=0)


def probability_of_improvement(scores: Scores, baseline: OtherScores) -> float:
    """Return the share of pairs of runs on a task in which the run scores more than the baseline. A tie counts half."""
    return float(np.mean((scores[:, None] > baseline) + 0.5 * (scores[:, None] == baseline)))


def mann_whitney_u(a: Float[np.ndarray, " a"], b: Float[np.ndarray, " b"]) -> float:
    """Return the number of pairs in which a is larger than b. A tie counts half."""
    return float(np.sum(a[:, None] > b) + 0.5 * np.sum(a[:, None] == b))


def mann_whitney(tasks: Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> tuple[float, float]:
    """Return two probabilities: that U is at least as large by chance, and that it is at most as large.

        U = sum over tasks and over all pairs of [a > b] + [a = b] / 2

    `tasks` has the values a and b of each task. If they had the same distribution, all ways to split them into two groups would
    be equally likely.
    """
    u, probabilities = 0.0, {0.0: 1.0}  # the distribution of U over the tasks so far
    for a, b in tasks:
        u += mann_whitney_u(a, b)
        values = np.concatenate([a, b])
        splits = [list(split) for split in itertools.combinations(range(len(values)), len(a))]
        task_us = [mann_whitney_u(values[split], np.delete(values, split)) for split in splits]
        convolved: dict[float, float] = {}
        for (total, probability), task_u in itertools.product(probabilities.items(), task_us):
            convolved[total + task_u] = convolved.get(total + task_u, 0.0) + probability / len(splits)
        probabilities = convolved
    at_least = sum(probability for total, probability in probabilities.items() if total >= u)
    at_most = sum(probability for total, probability in probabilities.items() if total <= u)
    return min(1.0, at_least), min(1.0, at_most)


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
