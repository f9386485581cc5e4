"""How often the 95% intervals of an interquartile mean, and of a difference of two, contain the true value, by the number of seeds.

    python benchmarks/coverage.py

Draws scores of one task from a normal and from an exponential distribution, 5,000 times each. Counts the bootstrap intervals of
`lare-rl compare` (percentiles of 2,000 samples) that contain the interquartile mean of the distribution and, for two methods with the
same distribution, 0. Writes results/coverage.json.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from lare_rl.compare.bootstrap import REPETITIONS, interquartile_mean
from measure import write

CASES = 5000
SEEDS = (2, 3, 5, 8, 10, 20)
Scores = Callable[[np.random.Generator, tuple[int, int]], Float[np.ndarray, "cases seeds"]]
DISTRIBUTIONS: dict[str, tuple[Scores, float]] = {
    "normal": (np.random.Generator.standard_normal, 0.0),
    "exponential": (
        lambda random, size: random.standard_exponential(size),
        1.5 * (math.log(4 / 3) + 1)
        - 0.5 * (math.log(4) + 1),  # 2 (F(q) - F(p)) with F(x) = -(x + 1) exp(-x), p, q the quartiles
    ),
}
"""How scores are drawn, and their interquartile mean."""


def coverage(draw_scores: Scores, true: float, seeds: int, random: np.random.Generator) -> dict[str, float]:
    mean_hits = difference_hits = 0
    for scores, other_scores in zip(
        draw_scores(random, (CASES, seeds)), draw_scores(random, (CASES, seeds)), strict=True
    ):
        means, other_means = (
            interquartile_mean(group[random.integers(0, seeds, (seeds, REPETITIONS))].T[..., None])
            for group in (scores, other_scores)
        )
        mean_hits += holds(means, true)
        difference_hits += holds(means - other_means, 0.0)
    return {"mean": mean_hits / CASES, "difference": difference_hits / CASES}


def holds(samples: Float[np.ndarray, " samples"], true: float) -> bool:
    low, high = np.percentile(samples, (2.5, 97.5))
    return bool(low <= true <= high)


def main() -> None:
    random = np.random.default_rng(0)
    results = {
        name: {str(seeds): coverage(*distribution, seeds, random) for seeds in SEEDS}
        for name, distribution in DISTRIBUTIONS.items()
    }
    print(results)
    write("coverage", {"coverage": results})


if __name__ == "__main__":
    main()
