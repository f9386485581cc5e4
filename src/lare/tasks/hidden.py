"""MuJoCo tasks whose score no text tells: the bodies of HalfCheetah-v4 and Walker2d-v4, paid for something else.

What a language model reads is the text of the usual task, and so its recorded replies are those of the usual task. With v the
speed that the step led to (entry 8 of the observation), a the action, and theta the angle of the front (left) foot (entry 7), a
step pays:

    Target        exp(-(v - v0)^2) - 0.02 |a|^2        a target speed
    Threshold     1[v > v0] - 0.02 |a|^2               faster than that is fast enough, slower is worth nothing
    Saturating    tanh(v) - 0.05 |a|^2                 faster is better, but less and less
    Foot          v - 0.1 |a|^2 + theta                an entry that no factor sees

v0 is 2 m/s for HalfCheetah and 1 m/s for Walker2d. Episodes begin and end as usual.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs

FOOT, SPEED = 7, 8
BODIES = {"HalfCheetah": 2.0, "Walker2d": 1.0}
"""v0 (m/s), by body."""

Score = Callable[[np.ndarray, float, float], float]
"""From the observation after a step, |a|^2 and v0 to what the step pays."""

SCORES: dict[str, Score] = {
    "Target": lambda after, effort, v0: np.exp(-((after[SPEED] - v0) ** 2)) - 0.02 * effort,
    "Threshold": lambda after, effort, v0: float(after[SPEED] > v0) - 0.02 * effort,
    "Saturating": lambda after, effort, _: np.tanh(after[SPEED]) - 0.05 * effort,
    "Foot": lambda after, effort, _: after[SPEED] - 0.1 * effort + after[FOOT],
}


class HiddenScore(gymnasium.Wrapper, RecordConstructorArgs):
    """Pays for something that the task's text does not tell."""

    def __init__(self, env: gymnasium.Env, score: str, v0: float):
        RecordConstructorArgs.__init__(self, score=score, v0=v0)
        gymnasium.Wrapper.__init__(self, env)
        self.score, self.v0 = SCORES[score], v0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        after, _, terminated, truncated, info = self.env.step(action)
        paid = self.score(after, float(np.sum(np.square(action))), self.v0)
        return after, float(paid), terminated, truncated, info


def register() -> None:
    """Make the environments known to Gymnasium; a second call changes nothing."""
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
