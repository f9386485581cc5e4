"""What histories and progress bring on scores that the texts of the task do not describe.

    python benchmarks/hidden.py

Each method is fitted to the returns of the first N episodes of a noisy policy (`noisy_policy.py`), on four hidden scores of the half
cheetah. The figure is the correlation of its proxy rewards with the true rewards of each step, on 20 other episodes.
"""

import gymnasium
import numpy as np
import tyro

from lare_rl.envs import mujoco_rewards
from lare_rl.envs.load import read_task
from measure import write
from noisy_policy import METHODS, assess, play

SCORES = "Target", "Foot", "Saturating", "Threshold"
COUNTS, N_TEST = (20, 60), 20


def main(seeds: int = 10) -> None:
    """Measure.

    Args:
        seeds: numbers of sets of episodes.
    """
    mujoco_rewards.register()
    rows: dict[str, list[float]] = {}
    for seed in range(seeds):
        for score in SCORES:
            task = f"HalfCheetah{score}-v4"
            episodes = play(gymnasium.make(read_task(task).environment), max(COUNTS) + N_TEST, seed)
            for method in METHODS:
                for count in COUNTS:
                    figure = assess(task, method, episodes[:count], episodes[max(COUNTS) :], "reward")
                    rows.setdefault(f"{score}, {method}, {count} episodes", []).append(figure)
        print(seed, {name: round(float(np.mean(values)), 2) for name, values in rows.items()}, flush=True)
    figures = {k: {"mean": float(np.mean(v)), "std": float(np.std(v, ddof=1)), "n": len(v)} for k, v in rows.items()}
    write("hidden", {"command": f"python benchmarks/hidden.py --seeds {seeds}", "rows": figures})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
