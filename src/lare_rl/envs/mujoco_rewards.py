"""Gymnasium's MuJoCo environments with other rewards than their descriptions suggest.

Dynamics, starts and ends of episodes are those of the original task. The language model reads the description of the original task,
so its recorded replies are those for the original task.

Hidden rewards, for HalfCheetah-v4 (v0 = 2 m/s) and Walker2d-v4 (v0 = 1 m/s). v is the forward velocity after the step (entry 8 of
the observation), theta the angle of the front or left foot (entry 7), and a the action:

    Target        r = exp(-(v - v0)^2) - 0.02 |a|^2        a target speed
    Threshold     r = 1[v > v0] - 0.02 |a|^2               a minimum speed
    Saturating    r = tanh(v) - 0.05 |a|^2                 faster is better, with a diminishing gain
    Foot          r = v - 0.1 |a|^2 + theta                an entry that no factor depends on

Sparse reward, for HalfCheetah-v4: 1 at the end of an episode that travels further than 500 m, else 0. This is the fully sparse task
of the LaRe paper, appendix F.6: I(final travel distance > 500). The published code requires a summed forward reward above 1000 instead,
which corresponds to 50 m at 0.05 s a step.
"""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs

__all__ = ["HIDDEN_REWARDS", "TARGET_SPEEDS", "OtherReward", "register"]

FOOT_ANGLE, VELOCITY = 7, 8
"""The indices of these entries of the observation."""
TARGET_SPEEDS = {"HalfCheetah": 2.0, "Walker2d": 1.0}
"""v0 (m/s), by body."""
SPARSE_DISTANCE = 500.0
"""The distance (m) of the sparse reward."""

Reward = Callable[[np.ndarray, float, float, Mapping[str, Any], bool], float]
"""A function from the next observation, the effort |a|^2, the target (v0 or the distance), `info` and whether the episode has ended."""

HIDDEN_REWARDS: dict[str, Reward] = {
    "Target": lambda next_obs, effort, v0, *_: np.exp(-((next_obs[VELOCITY] - v0) ** 2)) - 0.02 * effort,
    "Threshold": lambda next_obs, effort, v0, *_: float(next_obs[VELOCITY] > v0) - 0.02 * effort,
    "Saturating": lambda next_obs, effort, *_: np.tanh(next_obs[VELOCITY]) - 0.05 * effort,
    "Foot": lambda next_obs, effort, *_: next_obs[VELOCITY] - 0.1 * effort + next_obs[FOOT_ANGLE],
}
_REWARDS: dict[str, Reward] = {
    **HIDDEN_REWARDS,
    "Sparse": lambda _obs, _effort, distance, info, ended: ended and info["x_position"] > distance,
}


class OtherReward(gymnasium.Wrapper, RecordConstructorArgs):
    """Replaces the reward by one of `HIDDEN_REWARDS`, for a target speed, or by "Sparse", for a target distance."""

    def __init__(self, env: gymnasium.Env, reward: str, target: float):
        RecordConstructorArgs.__init__(self, reward=reward, target=target)
        gymnasium.Wrapper.__init__(self, env)
        self.compute_reward, self.target = _REWARDS[reward], target

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        next_obs, _, terminated, truncated, info = self.env.step(action)
        effort, ended = float(np.sum(np.square(action))), terminated or truncated
        reward = self.compute_reward(next_obs, effort, self.target, info, ended)
        return next_obs, float(reward), terminated, truncated, info


def register() -> None:
    """Register the environments with Gymnasium. Further calls change nothing."""
    _register("HalfCheetah", "Sparse", SPARSE_DISTANCE)
    for body, v0 in TARGET_SPEEDS.items():
        for reward in HIDDEN_REWARDS:
            _register(body, reward, v0)


def _register(body: str, reward: str, target: float) -> None:
    name = f"lare/{body}{reward}-v4"
    if name in gymnasium.registry:
        return
    spec = gymnasium.registry[f"{body}-v4"]
    # Gymnasium applies additional wrappers outside the time limit, so that they see the end of the episode.
    wrapper = WrapperSpec(
        OtherReward.__name__, f"{__name__}:{OtherReward.__name__}", {"reward": reward, "target": target}
    )
    gymnasium.register(
        name,
        entry_point=spec.entry_point,
        max_episode_steps=spec.max_episode_steps,
        additional_wrappers=(wrapper,),
    )
