"""The exact test of Mann and Whitney (1947), over several tasks."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.util.statistics import wins

__all__ = ["mann_whitney", "mann_whitney_u", "two_sided_p"]


def mann_whitney_u(a: Float[np.ndarray, " a"], b: Float[np.ndarray, " b"]) -> float:
    """Return the number of pairs in which a is larger than b. A tie counts half."""
    return float(np.sum(wins(a[:, None], b)))


def mann_whitney(tasks: Sequence[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> tuple[float, float]:
    """Return two probabilities: that U is at least as large by chance, and that it is at most as large.

        U = sum over tasks and over all pairs of [a > b] + [a = b] / 2

    `tasks` has the values a and b of each task. If they had the same distribution, all ways to split them into two groups would
    be equally likely.
    """
    double_u, probabilities = 0, np.ones(1)
    for a, b in tasks:
        double_u += round(2 * mann_whitney_u(a, b))
        probabilities = np.convolve(probabilities, _distribution(np.concatenate([a, b]), len(a)))
    at_least, at_most = probabilities[double_u:].sum(), probabilities[: double_u + 1].sum()
    return min(1.0, float(at_least)), min(1.0, float(at_most))


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
        counts[1:, rank:] += counts[:-1, :-rank].copy()
    first, last = n_a * (n_a + 1), n_a * (n_a + 1) + 2 * n_a * (len(values) - n_a)
    return counts[n_a, first : last + 1] / math.comb(len(values), n_a)
