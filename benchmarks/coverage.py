"""How often the 95% interval of an interquartile mean contains the true one, for several numbers of seeds on one task.

    python benchmarks/coverage.py

Draws scores from a normal and from an exponential distribution, 5,000 times each. Counts the bootstrap intervals of `lare compare`
(percentiles of 2,000 samples) that contain the interquartile mean of the distribution. Writes results/coverage.json.
"""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare.experiments.statistics import REPETITIONS, interquartile_means

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


def coverage(drawn: Scores, true: float, seeds: int, random: np.random.Generator) -> float:
    inside = 0
    for scores in drawn(random, (CASES, seeds)):
        samples = scores[random.integers(0, seeds, (seeds, REPETITIONS))]
        low, high = np.percentile(interquartile_means(samples[:, None]), (2.5, 97.5))
        inside += low <= true <= high
    return inside / CASES


def main() -> None:
    random = np.random.default_rng(0)
    found = {
        name: {str(seeds): coverage(*distribution, seeds, random) for seeds in SEEDS}
        for name, distribution in DISTRIBUTIONS.items()
    }
    place = Path(__file__).parent / "results" / "coverage.json"
    place.write_text(json.dumps({"command": "python benchmarks/coverage.py", "coverage": found}, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
