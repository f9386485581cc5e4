"""Nitrogen for wheat with SAC of Stable-Baselines3: the margin at harvest, a dense proxy, and LaRe.

    pip install -e '.[sb3]' -e 'benchmarks/real[wheat]'
    python benchmarks/wheat_sb3.py                       results/plugs/wheat-sac-REWARDS.jsonl
    python benchmarks/wheat_sb3.py --table               results/plugs/wheat_sac.json: means of the last quarter

SAC has the defaults of Stable-Baselines3, and 600 random steps at first. An evaluation plays each of the seven held-out years once,
with the deterministic policy. A seed that is in the file is not trained again.
"""

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import torch
import tyro
from stable_baselines3 import SAC

import lare_rl
from evaluations import Evaluations
from final_score.play import make_task
from final_score.wheat import find_years
from lare_rl.integrations.sb3 import CreditReplayBuffer
from measure import provenance, write
from scores.training import describe

REAL, RESULTS = Path(__file__).parent / "real", Path(__file__).parent / "results" / "plugs"
REWARDS = "episodic", "lare-bayes", "bayes", "proxy"
WARMUP = 600


def credit_arguments(rewards: str, env: gymnasium.Env, steps: int, seed: int) -> dict[str, Any]:
    """Return the plug's arguments; none if SAC learns from the rewards of its environment."""
    if rewards in ("episodic", "proxy"):
        return {}
    task = lare_rl.load_task(REAL / "tasks" / "wheat.toml")
    phi = lare_rl.load_function(REAL / "phi" / "wheat.py", task) if rewards.startswith("lare-") else None
    credit = lare_rl.CreditAssigner(rewards, phi, task=task, capacity=steps, seed=seed)
    return {"replay_buffer_class": CreditReplayBuffer, "replay_buffer_kwargs": {"credit": credit}}


def evaluate(model: SAC, env: gymnasium.Env) -> float:
    """Return the mean margin of the held-out years (100 EUR/ha)."""
    scores = []
    for year in find_years("test"):
        observation, _ = env.reset(options={"year": year})
        ended, info = False, {}
        while not ended:
            observation, _, ended, _, info = env.step(model.predict(observation, deterministic=True)[0])
        scores.append(info["score"])
    return float(np.mean(scores))


def train(rewards: str, seed: int, steps: int, evaluate_every: int) -> Iterator[dict[str, float]]:
    """Train one model. Yield its evaluations."""
    env, test = gymnasium.make("Wheat-v0", pay="proxy" if rewards == "proxy" else "end"), make_task("wheat", "test")
    plug = credit_arguments(rewards, env, steps, seed)
    model = SAC("MlpPolicy", env, buffer_size=steps, learning_starts=WARMUP, seed=seed, device="cpu", **plug)
    lines: list[dict[str, float]] = []

    def report(step: int) -> None:
        lines.append({"step": step, "seed": seed, "evaluation/return": evaluate(model, test)})

    model.learn(steps, log_interval=1_000_000, callback=Evaluations(evaluate_every, report))
    return iter(lines)


def read_seeds(path: Path) -> dict[int, list[dict[str, float]]]:
    """Return the evaluations of each seed in a file."""
    seeds: dict[int, list[dict[str, float]]] = {}
    for line in map(json.loads, path.read_text().splitlines() if path.exists() else []):
        if "seed" in line:
            seeds.setdefault(line["seed"], []).append(line)
    return seeds


def tabulate(rewards: tuple[str, ...]) -> None:
    """Write the mean returns of the last quarter of the evaluations, and each method beside `episodic`."""
    late = {}
    for name in rewards:
        seeds = read_seeds(RESULTS / f"wheat-sac-{name}.jsonl").values()
        last = max(line["step"] for lines in seeds for line in lines)
        late[name] = [
            float(np.mean([x["evaluation/return"] for x in lines if x["step"] > 0.75 * last])) for lines in seeds
        ]
    table = {name: describe(values, late["episodic"]) for name, values in late.items()}
    for name, row in table.items():
        print(f"{name:12s}", {key: np.round(value, 3).tolist() for key, value in row.items()})
    write("plugs/wheat_sac", {"table": table})


def main(
    rewards: tuple[str, ...] = REWARDS,
    seeds: int = 10,
    steps: int = 6_000,
    evaluate_every: int = 600,
    table: bool = False,
) -> None:
    """Train, and append each finished seed to the file of its rewards.

    Args:
        rewards: `episodic`, `proxy`, or a method.
        seeds: seeds 0 to N - 1.
        steps: environment steps of each seed; a season has about 20.
        evaluate_every: environment steps between two evaluations.
        table: tabulate the files, and train nothing.
    """
    if table:
        tabulate(rewards)
        return
    for seed in range(seeds):
        for name in rewards:
            path = RESULTS / f"wheat-sac-{name}.jsonl"
            if seed in read_seeds(path):
                continue
            lines = list(train(name, seed, steps, evaluate_every))
            new = not path.exists()
            with path.open("a") as file:
                if new:
                    print(json.dumps({"task": "Wheat", "steps": steps, **provenance()}), file=file)
                print(*map(json.dumps, lines), sep="\n", file=file)
            print(name, seed, [round(line["evaluation/return"], 2) for line in lines], flush=True)


if __name__ == "__main__":
    logging.getLogger("pcse").setLevel(logging.CRITICAL)
    jax.config.update("jax_platforms", "cpu")
    torch.set_num_threads(1)
    tyro.cli(main, description=__doc__)
