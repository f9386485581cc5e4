"""Statistics of few runs, with 95% intervals by the stratified bootstrap (Agarwal et al., "Deep Reinforcement Learning at the Edge of
the Statistical Precipice", NeurIPS 2021, sections 4.1 to 4.3), and the exact test of Mann and Whitney (1947), over several tasks.

`scores[..., n, m]` is the score of run n on task m. Each statistic is a pure function over the last two axes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.util.statistics import format_rounded, wins

__all__ = [
    "REPETITIONS",
    "Estimate",
    "Intervals",
    "OtherScores",
    "Scores",
    "bootstrap",
    "estimate",
    "interquartile_mean",
    "mann_whitney",
    "mann_whitney_u",
    "performance_profile",
    "probability_of_improvement",
    "two_sided_p",
]

REPETITIONS = 2000
"""Number of bootstrap samples."""
CHUNK = 100
"""The number of samples that are in memory at a time."""
MAX_EXACT = 100
"""The largest number of values of a task for which `mann_whitney` is exact."""
PERCENTILES = 2.5, 97.5
"""The ends of an interval."""

Scores = Float[np.ndarray, "*batch runs tasks"]
OtherScores = Float[np.ndarray, "*batch other_runs tasks"]


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


class Intervals(NamedTuple):
    """Numbers and their 95% intervals."""

    value: Float[np.ndarray, "*values"]
    low: Float[np.ndarray, "*values"]
    high: Float[np.ndarray, "*values"]


def interquartile_mean(scores: Scores) -> Float[np.ndarray, "*batch"]:
    """Return the mean of the middle half of the scores of all runs and tasks.

        IQM = mean of x_(k + 1) .. x_(N M - k),   k = floor(N M / 4)

    x_(i) is the i-th smallest of the N M scores.
    """
    ascending = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    cut = ascending.shape[-1] // 4
    return ascending[..., cut : ascending.shape[-1] - cut].mean(axis=-1)


def performance_profile(
    scores: Scores, thresholds: Float[np.ndarray, " thresholds"]
) -> Float[np.ndarray, "*batch thresholds"]:
    """Return the share of runs that score more than each threshold.

    F(tau) = 1 / (N M) * sum over n and m of [x_nm > tau]
    """
    return np.mean(scores[..., None] > thresholds, axis=(-3, -2))


def probability_of_improvement(scores: Scores, baseline: OtherScores) -> Float[np.ndarray, "*batch"]:
    """Return the share of pairs of runs on a task in which the run scores more than the baseline.

    P(X > Y) = 1 / M * sum over m of 1 / (N K) * sum over n and k of ([x_nm > y_km] + [x_nm = y_km] / 2)
    """
    x, y = scores[..., :, None, :], baseline[..., None, :, :]
    return np.mean(wins(x, y), axis=(-3, -2, -1))


def estimate(function: Callable[..., Float[np.ndarray, "*batch"]], *scores: Float[np.ndarray, "_ _"]) -> Estimate:
    """Estimate one number, which `function` computes of the last two axes of each of `scores`."""
    return Estimate(*map(float, bootstrap(function, *scores)))


def bootstrap(function: Callable[..., Float[np.ndarray, "*_"]], *scores: Float[np.ndarray, "*_"]) -> Intervals:
    """Return the values of a function of scores, and the ends of their intervals: percentiles over samples of the runs.

        x*_nm = x_(i_nm) m,   i_nm uniform in 1 .. N, independent for each run n and task m

    Axes before the last two, such as the points of a learning curve, share the indices, so that a sample has whole runs. Every call
    draws the same indices.

    Args:
        function: one of the statistics above, or a combination of them. The first axis of its arguments is the sample.
        scores: the runs of each array are sampled independently.
    """
    random = np.random.RandomState(0)  # NumPy keeps the stream of this generator unchanged
    samples = []
    for start in range(0, REPETITIONS, CHUNK):
        n_samples = min(CHUNK, REPETITIONS - start)
        indices = [[random.randint(x.shape[-2], size=x.shape[-2:]) for x in scores] for _ in range(n_samples)]
        samples.append(function(*map(_resample, scores, zip(*indices, strict=True))))
    low, high = np.percentile(np.concatenate(samples), PERCENTILES, axis=0)
    return Intervals(function(*(array[None] for array in scores))[0], low, high)


def _resample(
    scores: Float[np.ndarray, "*batch runs tasks"], indices: tuple[Int[np.ndarray, "runs tasks"], ...]
) -> Float[np.ndarray, "samples *batch runs tasks"]:
    index = np.stack(indices)
    index = index.reshape(len(indices), *(scores.ndim - 2) * [1], *scores.shape[-2:])
    return np.take_along_axis(scores[None], index, axis=-2)


def mann_whitney_u(a: Float[np.ndarray, " a"], b: Float[np.ndarray, " b"]) -> float:
    """Return the number of pairs in which a is larger than b. A tie counts half."""
    return float(np.sum(wins(a[:, None], b)))


def mann_whitney(tasks: Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> tuple[float, float]:
    """Return two probabilities: that U is at least as large by chance, and that it is at most as large.

        U = sum over tasks and over all pairs of [a > b] + [a = b] / 2

    `tasks` has the values a and b of each task. If they had the same distribution, all ways to split them into two groups would
    be equally likely. The probabilities are exact for up to `MAX_EXACT` values of a task, because they take time ~ n^4.
    """
    if max(len(a) + len(b) for a, b in tasks) > MAX_EXACT:
        return _normal_approximation(tasks)
    double_u, probabilities = 0, np.ones(1)
    for a, b in tasks:
        double_u += round(2 * mann_whitney_u(a, b))
        probabilities = np.convolve(probabilities, _distribution(np.concatenate([a, b]), len(a)))
    at_least, at_most = probabilities[double_u:].sum(), probabilities[: double_u + 1].sum()
    return min(1.0, float(at_least)), min(1.0, float(at_most))


def _normal_approximation(
    tasks: Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]],
) -> tuple[float, float]:
    """Return the probabilities of `mann_whitney` by a normal distribution, with corrections for continuity and for ties."""
    excess = variance = 0.0
    for a, b in tasks:
        n, n_equal = len(a) + len(b), np.unique(np.concatenate([a, b]), return_counts=True)[1].astype(float)
        excess += mann_whitney_u(a, b) - len(a) * len(b) / 2
        variance += len(a) * len(b) / 12 * (n + 1 - np.sum(n_equal**3 - n_equal) / (n * (n - 1)))
    if not variance:
        return 1.0, 1.0
    at_least, at_most = (math.erfc((sign * excess - 0.5) / math.sqrt(2 * variance)) / 2 for sign in (1, -1))
    return at_least, at_most


def two_sided_p(tasks: Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> float:
    """Return the two-sided p-value: twice the smaller probability of `mann_whitney`, but at most 1."""
    return min(1.0, 2 * min(mann_whitney(tasks)))


def _distribution(values: Float[np.ndarray, " values"], n_a: int) -> Float[np.ndarray, " sums"]:
    """Return the probabilities of 2 U = 0, 1, 2, ... over all choices of `n_a` of the values as a.

    2 U is the sum of the doubled ranks of a, less n_a (n_a + 1). Ties share their mean rank, so that doubled ranks are whole numbers.
    """
    doubled_ranks = 1 + np.sum(2 * (values < values[:, None]) + (values == values[:, None]), axis=1)
    # Choices by the number of values that they have, and by the sum of their doubled ranks.
    counts = np.zeros((n_a + 1, int(doubled_ranks.sum()) + 1))
    counts[0, 0] = 1
    for rank in doubled_ranks:
        counts[1:, rank:] += counts[:-1, :-rank]
    first, last = n_a * (n_a + 1), n_a * (n_a + 1) + 2 * n_a * (len(values) - n_a)
    return counts[n_a, first : last + 1] / math.comb(len(values), n_a)
