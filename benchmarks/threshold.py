"""How many episodes of random actions show that HalfCheetahThreshold-v4 pays for speed?

    python benchmarks/threshold.py

The score pays 1 for each step above 2 m/s and charges 0.02 |a|^2. Random actions are rarely that fast. Each method is fitted to the
returns of the first N episodes. Its proxy rewards of 20 other episodes are compared with the true rewards: what a fast step is paid
beyond a slow one (true: about 1), and the correlation. A policy is taught to move only if the first number is clearly above 0. The
last rows have a phi with the two terms of the score as factors: what could be known from so few returns, given the right features.
"""

import tempfile
from pathlib import Path

import gymnasium
import numpy as np
import tyro
from jaxtyping import Float

import lare_rl
from lare_rl.envs import mujoco_rewards
from measure import correlation, fit_once, record_episodes, write

TASK, SPEED, N_TEST = "HalfCheetahThreshold-v4", 2.0, 20
VELOCITY = 8
METHODS = "bayes", "lare-bayes", "bayes-history", "lare-bayes-history", "bayes-progress", "lare-bayes-progress", "terms"
TERMS_OF_THE_SCORE = """
def evaluation_func(observation, action):
    # the effort
    f_effort = -np.sum(np.square(action), axis=1, keepdims=True)
    # faster than 2 m/s
    f_fast = (observation[:, 8:9] > 2.0) * 1.0
    return [f_effort, f_fast]
"""


def play(n_episodes: int, seed: int) -> list[dict[str, Float[np.ndarray, "steps *entries"]]]:
    """Return episodes of random actions."""
    mujoco_rewards.register()
    env = gymnasium.make(f"lare/{TASK}")
    env.action_space.seed(seed)
    seeds = range(1000 * seed, 1000 * seed + n_episodes)
    episodes = record_episodes(env, seeds, lambda: lambda observation: env.action_space.sample())
    return [{name: values.astype(np.float32) for name, values in episode.items()} for episode in episodes]


def load_terms() -> lare_rl.LatentFunction:
    """Return a phi whose factors are the terms of the score."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "phi.py"
        path.write_text(TERMS_OF_THE_SCORE)
        return lare_rl.load_function(path, TASK)


def assess(method: str, episodes: list, test: list) -> dict[str, float]:
    """Fit a method to the returns of some episodes, and compare its rewards of other episodes with the true ones."""
    phi = load_terms() if method == "terms" else lare_rl.design(TASK) if method.startswith("lare-") else None
    credit = lare_rl.CreditAssigner("lare-bayes" if method == "terms" else method, phi, task=TASK)
    fit_once(credit, episodes)
    arrays = {k: np.concatenate([episode[k] for episode in test]) for k in test[0]}
    begins = np.concatenate([np.arange(len(episode["reward"])) == 0 for episode in test])
    r_hat = credit.rewards(arrays["observation"], arrays["action"], arrays["next_observation"], begins=begins)
    fast = arrays["next_observation"][:, VELOCITY] > SPEED
    return {
        "fast minus slow": float(r_hat[fast].mean() - r_hat[~fast].mean()),
        "correlation": correlation(r_hat, arrays["reward"]),
    }


def main(seeds: int = 10, counts: tuple[int, ...] = (60,)) -> None:
    """Measure.

    Args:
        seeds: numbers of sets of episodes.
        counts: the numbers of episodes that a decoder is fitted to.
    """
    rows, fast_steps = {}, []
    for seed in range(seeds):
        episodes = play(max(counts) + N_TEST, seed)
        episodes, test = episodes[: max(counts)], episodes[max(counts) :]
        fast_steps += [int((e["next_observation"][:, VELOCITY] > SPEED).sum()) for e in episodes]
        for method in METHODS:
            for count in counts:
                figures = assess(method, episodes[:count], test)
                for name, value in figures.items():
                    rows.setdefault(f"{method}, {count} episodes", {}).setdefault(name, []).append(value)
        print(seed, {k: {n: round(float(np.mean(x)), 2) for n, x in v.items()} for k, v in rows.items()}, flush=True)
    write(
        "threshold",
        {
            "command": f"python benchmarks/threshold.py --seeds {seeds}",
            "fast steps in an episode of 1000": {"mean": float(np.mean(fast_steps)), "std": float(np.std(fast_steps))},
            "rows": {
                k: {n: {"mean": float(np.mean(x)), "std": float(np.std(x, ddof=1)), "n": len(x)} for n, x in v.items()}
                for k, v in rows.items()
            },
        },
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
