"""The exact test of Mann and Whitney (1947), over several tasks."""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.util.statistics import wins

__all__ = ["mann_whitney", "mann_whitney_u"]


def mann_whitney_u(a: Float[np.ndarray, " a"], b: Float[np.ndarray, " b"]) -> float:
    """Return the number of pairs in which a is larger than b. A tie counts half."""
    return float(np.sum(wins(a[:, None], b)))


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
