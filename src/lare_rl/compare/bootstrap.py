"""Statistics of few runs, with 95% intervals by the stratified bootstrap (Agarwal et al., "Deep Reinforcement Learning at the Edge of
the Statistical Precipice", NeurIPS 2021, sections 4.1 to 4.3).

`scores[..., n, m]` is the score of run n on task m. Each statistic is a pure function over the last two axes.
"""

from collections.abc import Callable
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
    "performance_profile",
    "probability_of_improvement",
]

REPETITIONS = 2000
"""Number of bootstrap samples."""

CHUNK = 100
"""Samples that are in memory at a time."""

PERCENTILES = 2.5, 97.5

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
    """Estimate the values of a function of scores. Their intervals are percentiles over samples of the runs.

        x*_nm = x_(i_nm) m,   i_nm uniform in 1 .. N, independent for each run n and task m

    A sample of a learning curve has whole runs: further axes of `scores` share the indices, which are the same in every call.

    Args:
        function: one of the statistics above, or a combination of them. The first axis of its arguments is the sample.
        scores: the runs of each array are sampled independently.
    """
    random = np.random.RandomState(0)  # NumPy keeps the stream of this generator unchanged
    samples = []
    for start in range(0, REPETITIONS, CHUNK):
        indices = [_sample_indices(random, scores) for _ in range(min(CHUNK, REPETITIONS - start))]
        samples.append(function(*map(_resample, scores, zip(*indices, strict=True))))
    low, high = np.percentile(np.concatenate(samples), PERCENTILES, axis=0)
    return Intervals(function(*(array[None] for array in scores))[0], low, high)


def _sample_indices(
    random: np.random.RandomState, scores: tuple[Float[np.ndarray, "*_"], ...]
) -> list[Int[np.ndarray, "_ _"]]:
    """Sample the indices of as many runs as each array has, on each task."""
    return [random.randint(array.shape[-2], size=array.shape[-2:]) for array in scores]


def _resample(
    scores: Float[np.ndarray, "*batch runs tasks"], indices: tuple[Int[np.ndarray, "runs tasks"], ...]
) -> Float[np.ndarray, "samples *batch runs tasks"]:
    index = np.stack(indices)
    index = index.reshape(len(indices), *(scores.ndim - 2) * [1], *scores.shape[-2:])
    return np.take_along_axis(scores[None], index, axis=-2)
