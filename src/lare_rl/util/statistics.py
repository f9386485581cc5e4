"""Statistics of a few numbers, such as the returns of some seeds or episodes, and their texts."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = [
    "CLEAR_ERRORS",
    "CONSTANT",
    "FLOAT32_NOISE",
    "Band",
    "column_correlations",
    "correlation",
    "episode_error",
    "format_mean_std",
    "format_plus_minus",
    "format_rounded",
    "grouped_standard_error",
    "r_squared",
    "ratio_of_sums",
    "round_shares",
    "sample_std",
    "standard_error",
    "wins",
]

CLEAR_ERRORS = 2
"""A number is clear if it exceeds this many of its standard errors, or of its posterior standard deviations."""
FLOAT32_NOISE = 1e-6
"""In float32, a constant may vary by this fraction of its size."""
CONSTANT = 1e-10
"""Values count as equal if the sum of their squared deviations is below this fraction of the sum of their squares."""


class Band(NamedTuple):
    """A curve with an interval at each of its points."""

    x: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]
    low: Float[np.ndarray, " points"]
    high: Float[np.ndarray, " points"]


def wins(x: Float[np.ndarray, "*_"], y: Float[np.ndarray, "*_"]) -> Float[np.ndarray, "*_"]:
    """Return 1 where x is larger than y, 1/2 where they are equal, and 0 where y is larger."""
    return (x > y) + 0.5 * (x == y)


def sample_std(values: Float[np.ndarray, " values"]) -> float:
    """Return the standard deviation with n - 1, or 0 for fewer than two values. It is NaN if a value is infinite."""
    with np.errstate(invalid="ignore"):
        return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def standard_error(values: Float[np.ndarray, " values"]) -> float:
    """Return the standard error of the mean, or 0 for fewer than two values."""
    return sample_std(values) / math.sqrt(max(1, len(values)))


def grouped_standard_error(group_means: Float[np.ndarray, " groups"], error_within: float) -> float:
    """Return the larger of two standard errors of the mean of grouped values: between the groups, and `error_within` them.

    The groups are, for example, seeds, and the values the returns of their episodes.
    """
    return max(error_within, standard_error(group_means))


def episode_error(variances: Float[np.ndarray, " seeds"], n_episodes: int) -> float:
    """Return the standard error of the mean over all episodes, from the unbiased variance of each seed's episodes."""
    return math.sqrt(np.mean(variances) / (len(variances) * n_episodes))


def round_shares(shares: Sequence[float], total: float = 1.0) -> list[float]:
    """Round shares to whole percents that add up to `total`, itself a whole percent, by the largest remainder."""
    percents = 100 * np.asarray(shares, np.float64)
    rounded = np.floor(percents).astype(int)
    n_missing = round(100 * total) - int(rounded.sum())
    rounded[np.argsort(rounded - percents, kind="stable")[: max(0, n_missing)]] += 1
    return (rounded / 100).tolist()


def correlation(x: Float[np.ndarray, " values"], y: Float[np.ndarray, " values"]) -> float:
    """Return Pearson's correlation, or NaN for fewer than two values, or if one of the two never varies."""
    if len(x) < 2 or not (_varies(x) and _varies(y)):
        return math.nan
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(x, y)[0, 1])


def _varies(values: Float[np.ndarray, " values"]) -> bool:
    return bool(np.sum((values - values.mean()) ** 2) > CONSTANT * np.sum(values**2))


def column_correlations(
    columns: Float[np.ndarray, "rows columns"], y: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """Return Pearson's correlation of each column with `y`, NaN where one of the two never varies."""
    return np.array([correlation(column, y) for column in columns.T])


def r_squared(y: Float[np.ndarray, " values"], predicted: Float[np.ndarray, " values"]) -> tuple[float, float]:
    """Return R^2 of predictions and its standard error. Both are NaN if `y` never varies or has fewer than two values.

    R^2 = 1 - sum e / sum d,   e_k = (y_k - y_hat_k)^2,   d_k = (y_k - mean y)^2
    """
    if len(y) < 2:
        return math.nan, math.nan
    errors, deviations = (y - predicted) ** 2, (y - y.mean()) ** 2
    if not _varies(y):
        return math.nan, math.nan
    ratio, error = ratio_of_sums(errors, deviations)
    return 1 - ratio, error


def ratio_of_sums(x: Float[np.ndarray, " values"], y: Float[np.ndarray, " values"]) -> tuple[float, float]:
    """Return sum x / sum y and its standard error, for two or more pairs.

        error^2 = n / (n - 1) * sum_k (x_k - ratio * y_k)^2 / (sum y)^2

    This is the error of a linearised ratio (Cochran, Sampling Techniques, 3rd edition, 1977, section 2.11).
    """
    ratio = x.sum() / y.sum()
    variance = np.sum((x - ratio * y) ** 2) / y.sum() ** 2
    return float(ratio), float(np.sqrt(len(x) / (len(x) - 1) * variance))


def format_rounded(number: float, spread: float) -> str:
    """Round a number to three digits of its spread, or to four of its own if the spread is 0; at most six decimal places.

    A number that six places would not show is written with an exponent.
    """
    n_digits, size = (2, spread) if spread > 0 else (3, abs(number))
    n_places = max(n_digits - math.floor(math.log10(size)), 0) if 0 < size < math.inf else 3
    if n_places > 6 and 0 < abs(number) < 1e-4:
        return f"{number:.2e}"
    return f"{number:.{min(n_places, 6)}f}"


def format_plus_minus(mean: float, std: float | None) -> str:
    """Write a mean and its standard deviation, such as `71.00 ± 1.40`. Without a deviation, write the mean alone."""
    return format_rounded(mean, 0.0) if std is None else f"{format_rounded(mean, std)} ± {format_rounded(std, std)}"


def format_mean_std(values: Float[np.ndarray, " values"]) -> str:
    """Write the mean ± the standard deviation of some values, or a single value alone."""
    return format_plus_minus(float(np.mean(values)), sample_std(values) if len(values) > 1 else None)
