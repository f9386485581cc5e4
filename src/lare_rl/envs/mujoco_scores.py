"""MuJoCo tasks whose score differs from their description: HalfCheetah-v4 and Walker2d-v4 with other rewards.

The language model reads the description of the original task, so the recorded replies of the original task are used. With v the
speed after the step (entry 8 of the observation), a the action, and theta the angle of the front (left) foot (entry 7), the
reward of a step is:

    Target        exp(-(v - v0)^2) - 0.02 |a|^2        a target speed
    Threshold     1[v > v0] - 0.02 |a|^2               a minimum speed
    Saturating    tanh(v) - 0.05 |a|^2                 faster is better, with a diminishing gain
    Foot          v - 0.1 |a|^2 + theta                an entry that no factor depends on

v0 is 2 m/s for HalfCheetah and 1 m/s for Walker2d. Episodes start and end as in the original task.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs

FOOT, SPEED = 7, 8
BODIES = {"HalfCheetah": 2.0, "Walker2d": 1.0}
"""v0 (m/s) of each body."""

Score = Callable[[np.ndarray, float, float], float]
"""A function from the observation after a step, |a|^2 and v0 to the reward of the step."""

SCORES: dict[str, Score] = {
    "Target": lambda after, effort, v0: np.exp(-((after[SPEED] - v0) ** 2)) - 0.02 * effort,
    "Threshold": lambda after, effort, v0: float(after[SPEED] > v0) - 0.02 * effort,
    "Saturating": lambda after, effort, _: np.tanh(after[SPEED]) - 0.05 * effort,
    "Foot": lambda after, effort, _: after[SPEED] - 0.1 * effort + after[FOOT],
}


class HiddenScore(gymnasium.Wrapper, RecordConstructorArgs):
    """Replaces the reward by a score that the task's text does not describe."""

    def __init__(self, env: gymnasium.Env, score: str, v0: float):
        RecordConstructorArgs.__init__(self, score=score, v0=v0)
        gymnasium.Wrapper.__init__(self, env)
        self.score, self.v0 = SCORES[score], v0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        after, _, terminated, truncated, info = self.env.step(action)
        paid = self.score(after, float(np.sum(np.square(action))), self.v0)
        return after, float(paid), terminated, truncated, info


def register() -> None:
    """Register the environments with Gymnasium. Further calls change nothing."""
    for body, v0 in BODIES.items():
        usual = gymnasium.registry[f"{body}-v4"]
        for score in SCORES:
            name = f"lare/{body}{score}-v4"
            if name not in gymnasium.registry:
                pays = WrapperSpec("HiddenScore", f"{__name__}:HiddenScore", {"score": score, "v0": v0})
                gymnasium.register(
                    name,
                    entry_point=usual.entry_point,
                    max_episode_steps=usual.max_episode_steps,
                    additional_wrappers=(pays,),
                )
