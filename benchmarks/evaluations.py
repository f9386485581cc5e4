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
    resets = ({"seed": 1_000_000 + 1000 * seed + episode} for episode in range(episodes))
    return float(np.mean([play(model, environment, reset) for reset in resets]))


def play(model: Any, environment: gymnasium.Env, reset: dict[str, Any], deterministic: bool = True) -> float:
    """Return of an episode that begins with these arguments of `reset`."""
    normal = model.get_vec_normalize_env()
    observation, _ = environment.reset(**reset)
    return_, ended = 0.0, False
    while not ended:
        normalised = observation if normal is None else normal.normalize_obs(observation)
        action, _ = model.predict(normalised, deterministic=deterministic)
        observation, reward, terminated, truncated, _ = environment.step(action)
        return_, ended = return_ + float(reward), terminated or truncated
    return return_


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
