"""Which methods find credit in a score that is only won or lost?

    python benchmarks/sparse.py

The half cheetah wins if it travels further than 45 m in an episode. Episodes are those of a trained policy (`examples/trained`) with
noise, whose strength differs between episodes, so that about half of them are won. Each method is fitted to the outcomes of the first
N episodes. The figure is the correlation of its proxy rewards with the metres of each step, on 20 other episodes.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np
import tyro
from jaxtyping import Float

import lare_rl
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.envs.mujoco_rewards import SparseDistanceReward
from measure import correlation, fit_once, record_episodes, write

TASK, DISTANCE, N_TEST, MAX_NOISE = "HalfCheetahSparse-v4", 45.0, 20, 1.0
POLICY = Path(__file__).parent.parent / "examples" / "trained" / "HalfCheetah-v4"
METHODS = "bayes", "lare-bayes", "bayes-history", "lare-bayes-history", "bayes-progress", "lare-bayes-progress"
COUNTS = 20, 60


def play(n_episodes: int, seed: int) -> list[dict[str, Float[np.ndarray, "steps *entries"]]]:
    """Return episodes of the noisy policy, with the metres of each step."""
    sys.path.insert(0, str(POLICY))
    import exported

    policy, rng = exported.load("policy"), np.random.default_rng(seed)
    env = SparseDistanceReward(gymnasium.make("HalfCheetah-v4"), DISTANCE)

    def add_noise() -> Callable[[np.ndarray], np.ndarray]:
        noise = rng.uniform(0, MAX_NOISE)
        return lambda obs: np.clip(policy(observation=obs)["action"] + noise * rng.normal(size=6), -1, 1)

    episodes = record_episodes(env, range(1000 * seed, 1000 * seed + n_episodes), add_noise, ("x_position",))
    episodes = [{**e, "metres": np.diff(e["x_position"], prepend=0.0)} for e in episodes]
    return [{name: values.astype(np.float32) for name, values in e.items()} for e in episodes]


def assess(method: str, score: Literal["auto", "binary"], episodes: list, test: list) -> float:
    """Fit a method to the outcomes of some episodes, and correlate its rewards of other episodes with the metres of their steps."""
    phi = lare_rl.design(TASK) if method.startswith("lare-") else None
    credit = lare_rl.CreditAssigner(method, phi, task=TASK, settings=CreditSettings(score=score))
    half = len(episodes) // 2
    for batch in episodes[:half], episodes[half:]:  # predictions of the second decide whether odds are fitted
        fit_once(credit, batch)
    arrays = {k: np.concatenate([episode[k] for episode in test]) for k in test[0]}
    begins = np.concatenate([np.arange(len(episode["metres"])) == 0 for episode in test])
    r_hat = credit.rewards(arrays["observation"], arrays["action"], arrays["next_observation"], begins=begins)
    return correlation(r_hat, arrays["metres"])


def main(seeds: int = 10) -> None:
    """Measure.

    Args:
        seeds: numbers of sets of episodes.
    """
    rows: dict[str, list[float]] = {}
    won: list[float] = []
    for seed in range(seeds):
        episodes = play(max(COUNTS) + N_TEST, seed)
        won += [float(episode["reward"].sum()) for episode in episodes]
        for method in METHODS:
            for score in ("auto",) if method.endswith("progress") else ("auto", "binary"):
                for count in COUNTS:
                    figure = assess(method, score, episodes[:count], episodes[max(COUNTS) :])
                    rows.setdefault(f"{method}, {score}, {count} episodes", []).append(figure)
        print(seed, {name: round(float(np.mean(values)), 2) for name, values in rows.items()}, flush=True)
    figures = {k: {"mean": float(np.mean(v)), "std": float(np.std(v, ddof=1)), "n": len(v)} for k, v in rows.items()}
    write(
        "sparse",
        {"command": f"python benchmarks/sparse.py --seeds {seeds}", "won": float(np.mean(won)), "rows": figures},
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
