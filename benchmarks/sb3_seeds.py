"""Scores that come only at the end, in Stable-Baselines3, ten seeds: SAC on wheat, PPO on pickers, a traffic signal and a job shop.

    pip install -e '.[sb3]' -e 'benchmarks/real[wheat,traffic,jobshop]'
    PYTHONPATH=examples python benchmarks/sb3_seeds.py wheat             results/plugs/wheat-REWARDS.jsonl
    PYTHONPATH=examples python benchmarks/sb3_seeds.py wheat --table     results/plugs/wheat.json: tables

The algorithms have the defaults of Stable-Baselines3, except those of `TASKS`. Evaluations play the deterministic policy (wheat: each
of the seven held-out years once) or the sampled one (new or held-out episodes). A seed that is in a file is not trained again.
"""

import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import jax
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO, SAC

import lare_rl
from evaluations import Evaluations, play
from lare_rl.integrations.sb3 import CreditCallback, CreditReplayBuffer
from measure import provenance, write
from scores.training import describe

ROOT, RESULTS = Path(__file__).parents[1], Path(__file__).parent / "results" / "plugs"
Line = dict[str, float]


class Setting(NamedTuple):
    """What is trained, and how it is evaluated."""

    task: Path
    phi: Path
    make: Callable[[str], gymnasium.Env]
    """From the name of the rewards to the environment of training."""
    resets: Callable[[], tuple[gymnasium.Env, list[dict[str, Any]]]]
    """The environment of evaluations, and the arguments of `reset` for each of their episodes."""
    model: type
    arguments: dict[str, Any]
    """Arguments of the model."""
    steps: int
    evaluate_every: int
    deterministic: bool
    rewards: tuple[str, ...]


def make_simulator(task: str, split: Literal["train", "test"], rewards: str = "") -> gymnasium.Env:
    """Make a simulator of `benchmarks/real`."""
    from final_score.play import make_task

    return make_task(task, split, pay="proxy" if rewards == "proxy" else "end")


def wheat_resets() -> tuple[gymnasium.Env, list[dict[str, Any]]]:
    from final_score.wheat import find_years

    return make_simulator("wheat", "test"), [{"options": {"year": year}} for year in find_years("test")]


def simulator_resets(task: str, episodes: int) -> tuple[gymnasium.Env, list[dict[str, Any]]]:
    return make_simulator(task, "test"), [{"seed": 1_000_000 + episode} for episode in range(episodes)]


def make_pickers(rewards: str) -> gymnasium.Env:
    return gymnasium.make("pickers:Pickers-v0")


def picker_resets() -> tuple[gymnasium.Env, list[dict[str, Any]]]:
    return make_pickers(""), [{"seed": 1_000_000 + episode} for episode in range(50)]


TASKS = {
    "wheat": Setting(
        ROOT / "benchmarks/real/tasks/wheat.toml",
        ROOT / "benchmarks/real/phi/wheat.py",
        partial(make_simulator, "wheat", "train"),
        wheat_resets,
        SAC,
        {"learning_starts": 600, "buffer_size": 6_000},
        steps=6_000,
        evaluate_every=600,
        deterministic=True,
        rewards=("episodic", "lare-bayes", "bayes", "proxy"),
    ),
    "pickers": Setting(
        ROOT / "examples/pickers.toml",
        ROOT / "examples/phi/pickers.py",
        make_pickers,
        picker_resets,
        PPO,
        {"n_steps": 1_920},  # 16 shifts
        steps=57_600,
        evaluate_every=5_760,
        deterministic=False,
        rewards=("episodic", "lare-bayes", "bayes"),
    ),
    "traffic": Setting(
        ROOT / "benchmarks/real/tasks/traffic.toml",
        ROOT / "benchmarks/real/phi/traffic.py",
        partial(make_simulator, "traffic", "train"),
        partial(simulator_resets, "traffic", 4),
        PPO,
        {"n_steps": 1_440, "batch_size": 72},  # 4 hours
        steps=36_000,
        evaluate_every=7_200,
        deterministic=False,
        rewards=("episodic", "whole-episode", "lare-bayes", "bayes", "proxy"),
    ),
    "jobshop": Setting(
        ROOT / "benchmarks/real/tasks/jobshop.toml",
        ROOT / "benchmarks/real/phi/jobshop.py",
        partial(make_simulator, "jobshop", "train"),
        partial(simulator_resets, "jobshop", 20),
        PPO,
        {"n_steps": 2_000, "batch_size": 100},
        steps=100_000,
        evaluate_every=10_000,
        deterministic=False,
        rewards=("episodic", "whole-episode", "lare-bayes", "bayes", "proxy"),
    ),
}


def train(setting: Setting, rewards: str, seed: int) -> list[Line]:
    """Train a model. Return its evaluations."""
    arguments: dict[str, Any] = {**setting.arguments, "seed": seed, "device": "cpu"}
    callbacks: list[Any] = []
    if rewards == "whole-episode":
        arguments |= {"gamma": 1.0, "gae_lambda": 1.0}
    elif rewards not in ("episodic", "proxy"):
        task = lare_rl.load_task(setting.task)
        phi = lare_rl.load_function(setting.phi, task) if rewards.startswith("lare-") else None
        credit = lare_rl.CreditAssigner(rewards, phi, task=task, capacity=setting.steps, seed=seed)
        if setting.model is PPO:
            callbacks = [CreditCallback(credit)]
        else:
            arguments |= {"replay_buffer_class": CreditReplayBuffer, "replay_buffer_kwargs": {"credit": credit}}
    training_env = setting.make(rewards)
    model = setting.model("MlpPolicy", training_env, **arguments)
    env, resets = setting.resets()
    lines: list[Line] = []

    def report(step: int) -> None:
        scores = [play(model, env, reset, setting.deterministic) for reset in resets]
        lines.append({"step": step, "seed": seed, "evaluation/return": float(np.mean(scores))})

    model.learn(
        setting.steps, log_interval=1_000_000, callback=[*callbacks, Evaluations(setting.evaluate_every, report)]
    )
    env.close()
    training_env.close()
    return lines


def read_seeds(path: Path) -> dict[int, list[Line]]:
    """Return the evaluations of each seed in a file."""
    seeds: dict[int, list[Line]] = {}
    for line in map(json.loads, path.read_text().splitlines() if path.exists() else []):
        if "seed" in line:
            seeds.setdefault(line["seed"], []).append(line)
    return seeds


def tabulate(name: str, rewards: tuple[str, ...], steps: int) -> None:
    """Write the mean returns of the last quarter of the evaluations and of all, and each method beside the score at the end."""
    tables = {}
    for measure, after in (("late", 0.75), ("area", 0.0)):
        returns = {}
        for method in rewards:
            seeds = read_seeds(RESULTS / f"{name}-{method}.jsonl").values()
            returns[method] = [mean_return(lines, after * steps) for lines in seeds]
        baseline = returns.get("whole-episode", returns["episodic"])
        tables[measure] = {method: describe(values, baseline) for method, values in returns.items()}
        for method, row in tables[measure].items():
            print(f"{measure} {method:12s}", {key: np.round(value, 3).tolist() for key, value in row.items()})
    write(f"plugs/{name}", {"tables": tables})


def mean_return(lines: list[Line], after: float) -> float:
    """Return the mean return of the evaluations after a step."""
    return float(np.mean([line["evaluation/return"] for line in lines if line["step"] > after]))


def main(
    task: tyro.conf.Positional[Literal["wheat", "pickers", "traffic", "jobshop"]],
    rewards: tuple[str, ...] = (),
    seeds: int = 10,
    table: bool = False,
) -> None:
    """Train, and append each finished seed to the file of its rewards.

    Args:
        task: the task.
        rewards: `episodic`, `whole-episode` (the same, PPO with gamma = lambda = 1), `proxy` (simulators), or methods; all of the task
            by default.
        seeds: seeds 0 to N - 1.
        table: tabulate the files, and train nothing.
    """
    setting = TASKS[task]
    rewards = rewards or setting.rewards
    if table:
        tabulate(task, rewards, setting.steps)
        return
    for seed in range(seeds):
        for method in rewards:
            path = RESULTS / f"{task}-{method}.jsonl"
            if seed in read_seeds(path):
                continue
            lines = train(setting, method, seed)
            header = [] if path.exists() else [{"task": task, "steps": setting.steps, **provenance()}]
            with path.open("a") as file:
                print(*map(json.dumps, [*header, *lines]), sep="\n", file=file)
            print(method, seed, [round(line["evaluation/return"], 2) for line in lines], flush=True)


if __name__ == "__main__":
    logging.getLogger("pcse").setLevel(logging.CRITICAL)
    jax.config.update("jax_platforms", "cpu")
    torch.set_num_threads(1)
    tyro.cli(main, description=__doc__)
