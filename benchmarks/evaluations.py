"""Evaluations of models of Stable-Baselines3 and SBX while they learn."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback


def evaluate(model: Any, environment: gymnasium.Env, seed: int, episodes: int) -> float:
    """Mean return of the deterministic policy, from the same initial states at every evaluation."""
    normal = model.get_vec_normalize_env()
    returns = np.zeros(episodes)
    for episode in range(episodes):
        observation, _ = environment.reset(seed=1_000_000 + 1000 * seed + episode)
        ended = False
        while not ended:
            normalised = observation if normal is None else normal.normalize_obs(observation)
            action, _ = model.predict(normalised, deterministic=True)
            observation, reward, terminated, truncated, _ = environment.step(action)
            returns[episode] += float(reward)
            ended = terminated or truncated
    return float(returns.mean())


def append_evaluation(out: Path, model: Any, environment: gymnasium.Env, seed: int, episodes: int, step: int) -> None:
    """Evaluate a model, append a line of JSON to `out`, and print it."""
    line = {"step": step, "seed": seed, "evaluation/return": evaluate(model, environment, seed, episodes)}
    with out.open("a") as file:
        print(json.dumps(line), file=file)
    print(f"seed {seed}  step {step:>7d}  return {line['evaluation/return']:10.1f}", flush=True)


class Evaluations(BaseCallback):
    """Evaluates after each `interval` steps and the update that follows."""

    def __init__(self, interval: int, report: Callable[[int], None]):
        super().__init__()
        self.interval, self.report = interval, report

    def _on_rollout_start(self) -> None:
        if self.num_timesteps and self.num_timesteps % self.interval == 0:
            self.report(self.num_timesteps)

    def _on_training_end(self) -> None:
        self.report(self.num_timesteps)

    def _on_step(self) -> bool:
        return True
