"""How far the mean correlation of observations with the true reward depends on the sample of episodes.

    python benchmarks/sampling.py

For CN-6 and PP-6: the mean absolute correlation over 1,000 episodes of random actions, and over each 40 of them.
"""

import numpy as np

import lare_rl
from lare_rl.evaluation.episode_credit import correlations
from measure import write
from paper.correlations import random_steps

EPISODES, SAMPLE = 1000, 40


def main() -> None:
    found = {}
    for name in ("CN-6", "PP-6"):
        steps = random_steps(lare_rl.load_task(name), EPISODES)
        pieces = [np.array_split(part, EPISODES // SAMPLE) for part in (steps.after, steps.reward)]
        of_pieces = [mean(*piece) for piece in zip(*pieces, strict=True)]
        found[name] = {"all": mean(steps.after, steps.reward), "least": min(of_pieces), "most": max(of_pieces)}
        print(name, found[name])
    write("sampling", {"episodes": EPISODES, "sample": SAMPLE, "absolute correlation": found})


def mean(observation: np.ndarray, reward: np.ndarray) -> float:
    return round(float(np.nanmean(np.abs(correlations(observation, reward)))), 3)


if __name__ == "__main__":
    main()
