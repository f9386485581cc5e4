"""How well do methods predict makespans, which are a maximum and not a sum?

    python benchmarks/makespan.py

Random actions in the job shop of `benchmarks/real`, whose package must be installed. Each method is fitted to 64 episodes. The figure is
R^2 of the scores of 32 other episodes.
"""

from pathlib import Path

import gymnasium
import numpy as np
import tyro

import lare_rl
from measure import fit_once, record_episodes, write

N_FITTED, N_TEST = 64, 32
REAL = Path(__file__).parent / "real"
TASK, PHI = REAL / "tasks" / "jobshop.toml", REAL / "phi" / "jobshop.py"
METHODS = "bayes", "bayes-history", "bayes-progress", "lare-bayes", "lare-bayes-history", "lare-bayes-progress"


def play(seed: int) -> list[dict[str, np.ndarray]]:
    """Return episodes of random actions."""
    env = gymnasium.make("final_score:JobShop-v0")
    env.action_space.seed(seed)
    seeds = range(1000 * seed, 1000 * seed + N_FITTED + N_TEST)
    return record_episodes(env, seeds, lambda: lambda observation: env.action_space.sample())


def measure_r2(method: str, episodes: list) -> float:
    """Return R^2 of the last scores, each predicted before it was fitted."""
    phi = lare_rl.load_function(PHI, TASK) if method.startswith("lare-") else None
    credit = lare_rl.CreditAssigner(method, phi, task=TASK)
    for batch in episodes[:N_FITTED], episodes[N_FITTED:]:
        fit_once(credit, batch)
    return credit.metrics()["credit/return_r2"]


def main(seeds: int = 10) -> None:
    """Measure.

    Args:
        seeds: numbers of sets of episodes.
    """
    r2: dict[str, list[float]] = {method: [] for method in METHODS}
    for seed in range(seeds):
        episodes = play(seed)
        for method in METHODS:
            r2[method].append(measure_r2(method, episodes))
        print(seed, {method: round(values[-1], 2) for method, values in r2.items()}, flush=True)
    rows = {m: {"mean": float(np.mean(v)), "std": float(np.std(v, ddof=1)), "n": len(v)} for m, v in r2.items()}
    write("makespan", {"command": f"python benchmarks/makespan.py --seeds {seeds}", "rows": rows})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
