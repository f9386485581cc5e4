"""Shared by the benchmarks: episodes, interleaved rounds, sessions to time, and results with their provenance."""

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float

import lare_rl
from lare_rl.config.resolve import resolve
from lare_rl.runs.directory import create_run
from lare_rl.training.latent_functions import choose_functions
from lare_rl.training.session import Session, start_session
from lare_rl.util.provenance import code_version

PACKAGES = (
    "lare-rl",
    "jax",
    "jaxlib",
    "optax",
    "numpy",
    "gymnasium",
    "mujoco",
    "mpe2",
    "stable-baselines3",
    "sbx-rl",
    "torch",
    "textworld",
    "jericho",
)

TD3 = {
    "learning_rate": 3e-4,
    "buffer_size": 1_000_000,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "train_freq": 1,
    "gradient_steps": 1,
    "policy_delay": 2,
    "policy_kwargs": {"net_arch": [256, 256]},
}
"""Hyperparameters of the paper's TD3, as Stable-Baselines3 and SBX call them."""

PPO = {
    "learning_rate": lambda remaining: 3e-4 * remaining,
    "clip_range": lambda remaining: 0.2 * remaining,
    "n_steps": 2000,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "ent_coef": 0.01,
}
"""Hyperparameters of our PPO, likewise. Each library has its own names for the networks (256-256 with tanh)."""


def apart(rewards: Float[np.ndarray, "episodes steps *agents"]) -> Float[np.ndarray, "episodes steps *agents"]:
    """Rewards as deviations from their episode's mean."""
    return rewards - rewards.mean(1, keepdims=True)


def record_episodes(
    env: gymnasium.Env,
    seeds: Iterable[int],
    make_policy: Callable[[], Callable[[Any], Any]],
    info_names: tuple[str, ...] = (),
) -> list[dict[str, np.ndarray]]:
    """Play an episode from each seed by a new policy. Return its steps as arrays, with these values of `info`."""
    names = "observation", "action", "next_observation", "reward", *info_names
    episodes = []
    for seed in seeds:
        policy, (observation, _), rows, done = make_policy(), env.reset(seed=seed), [], False
        while not done:
            action = policy(observation)
            next_observation, reward, terminated, truncated, info = env.step(action)
            rows.append((observation, action, next_observation, reward, *(info[name] for name in info_names)))
            observation, done = next_observation, terminated or truncated
        episodes.append(dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True)))
    return episodes


def fit_once(credit: lare_rl.CreditAssigner, episodes: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Fit to the returns of some episodes.

    All episodes come in one call. If they came one by one, a decoder in closed form would be fitted after every few of them.
    """
    arrays = {name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]}
    steps = arrays["observation"], arrays["action"], arrays["next_observation"]
    lengths = [len(e["reward"]) for e in episodes]
    ended = np.zeros(sum(lengths), bool)
    ended[np.cumsum(lengths) - 1] = True
    credit.add(
        *steps,
        arrays["reward"],
        ended,
        np.zeros_like(ended),
        env_ids=np.repeat(np.arange(len(lengths)), lengths).tolist(),
    )
    credit.fit()


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Pearson's correlation over all entries."""
    return float(np.corrcoef(x.ravel(), y.ravel())[0, 1])


def interleave(
    contenders: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds that each contender took in each round: A B C A B C ..., after one round that compiles and is not counted.

    On a machine that others use too, take `time.process_time`, which counts processor time.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds + 1):
        for name, work in contenders.items():
            start = clock()
            work()
            if number:
                seconds[name].append(clock() - start)
    return seconds


def ratio(seconds: Sequence[float], reference: Sequence[float]) -> float:
    """Median over the rounds of the ratio within a round, so that a slowdown of a whole round cancels out."""
    return median(x / y for x, y in zip(seconds, reference, strict=True))


def summary(seconds: Mapping[str, Sequence[float]], per: int, reference: str) -> dict[str, dict[str, Any]]:
    """Milliseconds for one of the `per` units of work in a round, and the ratio to `reference`."""
    table = {}
    for name, values in seconds.items():
        ms = [1000 * value / per for value in values]
        figures = {"median ms": median(ms), "least ms": min(ms), "most ms": max(ms)}
        table[name] = {
            **figures,
            "ratio": ratio(values, seconds[reference]),
            "rounds ms": [round(x, 4) for x in ms],
        }
    return table


def show(title: str, table: Mapping[str, Mapping[str, Any]], reference: str) -> None:
    print(f"\n{title:28s} {'median ms':>10s} {'least':>9s} {'most':>9s}   to {reference}")
    for name, row in table.items():
        print(f"{name:28s} {row['median ms']:10.4f} {row['least ms']:9.4f} {row['most ms']:9.4f} {row['ratio']:8.3f}")


def write(name: str, figures: Mapping[str, Any]) -> None:
    """Write results/NAME.json: the figures, the command, and everything that they depend on."""
    out = Path(__file__).parent / "results" / f"{name}.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps({**provenance(), **figures}, indent=1) + "\n")
    print(f"\nwritten to {out.relative_to(Path(__file__).parent.parent)}")


def provenance() -> dict[str, Any]:
    """The command, the machine and the versions of all packages that figures depend on."""
    versions = {"lare": code_version(), "python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    command = " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    return {"command": command, "machine": machine(), "versions": versions}


def machine() -> dict[str, Any]:
    """Processor and cores; `usable` are those that this process may run on (`taskset`)."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    model = models[0] if models else platform.processor()
    return {"processor": model, "cores": os.cpu_count(), "usable": usable, "backend": jax.default_backend()}


def new_session(directory: Path, task_name: str, settings: lare_rl.Settings) -> Session:
    """The session that `lare_rl.train` starts, without its loop."""
    task = lare_rl.load_task(task_name)
    resolved = resolve(settings, task)
    return start_session(create_run(directory, task, resolved, choose_functions(task, resolved, None)))


def advance(session: Session, steps: int) -> None:
    """Make `steps` environment steps of each seed, and wait for all computations."""
    until = session.step + steps
    while session.step < until:
        session.advance(until)
    jax.block_until_ready(session.learner)
