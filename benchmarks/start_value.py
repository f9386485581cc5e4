"""What a start value costs a sum that has none, and what it gains where there is one.

    python benchmarks/start_value.py

Episodes have 5 to 50 steps. The reward of a step is 0.5 + w . s with w ~ N(0, 1) and s ~ N(0, 1) of 4 entries, and noise of deviation 1
that no observation tells. The score is the sum of the rewards plus a start value. `bayes` is fitted to scores. The error is that of the
proxy rewards of all steps: their mean squared difference from 0.5 + w . s, over its variance. Ten sets of episodes.
"""

from typing import Any

import numpy as np
import tyro

from lare_rl import CreditAssigner, CreditSettings
from measure import write

N_ENTRIES = 4
START_VALUES = 0.0, -50.0


def measure(start_value: float, n_episodes: int, seed: int, score: str) -> tuple[float, float]:
    """Return the relative squared error and the mean error of the proxy rewards. `score` is "no" for a sum without a start value."""
    random = np.random.default_rng(seed)
    weight = random.normal(size=N_ENTRIES)
    settings = CreditSettings(score="auto" if score == "auto" else "sum", start_value=score != "no")
    credit = CreditAssigner(
        "bayes", observation_space=N_ENTRIES, action_space=1, scored_observation="before", settings=settings
    )
    expected, numbers = [], []
    for _ in range(n_episodes):
        n_steps = int(random.integers(5, 51))
        states, actions = random.normal(size=(n_steps + 1, N_ENTRIES)), random.normal(size=(n_steps, 1))
        expected.append(0.5 + states[:-1] @ weight)
        score_value = (expected[-1] + random.normal(size=n_steps)).sum() + start_value
        numbers.append(credit.add_episode(states[:-1], actions, states[1:], score_value))
    r_hat = [credit.rewards_at(steps) for steps in numbers]
    error = np.concatenate(r_hat) - np.concatenate(expected)
    return float(np.mean(error**2) / np.var(np.concatenate(expected))), float(error.mean())


def main(seeds: int = 10) -> None:
    """Measure and tabulate.

    Args:
        seeds: the number of sets of episodes.
    """
    tables: dict[str, Any] = {}
    for start_value in START_VALUES:
        for n_episodes in (30, 100, 300):
            row: dict[str, Any] = {}
            for score in ("sum", "no", "auto"):
                results = np.array([measure(start_value, n_episodes, seed, score) for seed in range(seeds)])
                row[score] = {"error": results[:, 0].tolist(), "mean error": results[:, 1].tolist()}
                mean, std = results.mean(axis=0), results.std(axis=0, ddof=1)
                print(start_value, n_episodes, score, f"{mean[0]:.3f} ± {std[0]:.3f}, mean {mean[1]:+.3f}", flush=True)
            tables[f"start value {start_value:g}, {n_episodes} episodes"] = row
    write("start_value", {"command": "python benchmarks/start_value.py", "seeds": list(range(seeds)), "tables": tables})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
