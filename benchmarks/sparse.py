"""Which methods find credit in a score that is only won or lost?

    python benchmarks/sparse.py

The half cheetah wins if it travels further than 45 m in an episode. Episodes are those of a noisy policy (`noisy_policy.py`), and about
half of them are won. Each method is fitted to the outcomes of the first N episodes. The figure is the correlation of its proxy rewards
with the metres of each step, on 20 other episodes.
"""

import gymnasium
import numpy as np
import tyro

from lare_rl.envs.mujoco_rewards import OtherReward
from measure import write
from noisy_policy import METHODS, Episode, assess, play

TASK, DISTANCE, N_TEST = "HalfCheetahSparse-v4", 45.0, 20
COUNTS = 20, 60


def play_with_metres(n_episodes: int, seed: int) -> list[Episode]:
    env = OtherReward(gymnasium.make("HalfCheetah-v4"), "Sparse", DISTANCE)
    episodes = play(env, n_episodes, seed, ("x_position",))
    return [{**e, "metres": np.diff(e["x_position"], prepend=np.float32(0))} for e in episodes]


def main(seeds: int = 10) -> None:
    """Measure.

    Args:
        seeds: numbers of sets of episodes.
    """
    rows: dict[str, list[float]] = {}
    won: list[float] = []
    for seed in range(seeds):
        episodes = play_with_metres(max(COUNTS) + N_TEST, seed)
        won += [float(episode["reward"].sum()) for episode in episodes]
        test = episodes[max(COUNTS) :]
        for method in METHODS:
            for score in ("auto",) if method.endswith("progress") else ("auto", "binary"):
                for count in COUNTS:
                    figure = assess(TASK, method, episodes[:count], test, "metres", score)
                    rows.setdefault(f"{method}, {score}, {count} episodes", []).append(figure)
        print(seed, {name: round(float(np.mean(values)), 2) for name, values in rows.items()}, flush=True)
    figures = {k: {"mean": float(np.mean(v)), "std": float(np.std(v, ddof=1)), "n": len(v)} for k, v in rows.items()}
    write(
        "sparse",
        {"command": f"python benchmarks/sparse.py --seeds {seeds}", "won": float(np.mean(won)), "rows": figures},
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
