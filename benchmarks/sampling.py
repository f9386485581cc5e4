"""How far the mean correlation of observations with the true reward depends on the sample of episodes.

    python benchmarks/sampling.py

For CN-6 and PP-6: the mean absolute correlation over 1,000 episodes of random actions, and over each 40 of them.
"""

import numpy as np

import lare_rl
from lare_rl.util.statistics import column_correlations
from measure import write
from paper.correlations import random_steps

EPISODES, SAMPLE = 1000, 40


def main() -> None:
    results = {}
    for name in ("CN-6", "PP-6"):
        steps = random_steps(lare_rl.load_task(name), EPISODES)
        pieces = [np.array_split(array, EPISODES // SAMPLE) for array in (steps.after, steps.reward)]
        piece_means = [mean(*piece) for piece in zip(*pieces, strict=True)]
        results[name] = {"all": mean(steps.after, steps.reward), "least": min(piece_means), "most": max(piece_means)}
        print(name, results[name])
    write("sampling", {"episodes": EPISODES, "sample": SAMPLE, "absolute correlation": results})


def mean(observation: np.ndarray, reward: np.ndarray) -> float:
    return round(float(np.nanmean(np.abs(column_correlations(observation, reward)))), 3)


if __name__ == "__main__":
    main()
