"""The episodic setting: the agent receives the return of an episode at its last step, and 0 before."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from lare_rl.envs.env_errors import convert_output, to_float
from lare_rl.errors import LareError

__all__ = ["TRUE_REWARD", "EpisodicReward", "read_score"]

TRUE_REWARD = "true_reward"
"""The key of `info` with the true reward of the step."""


class EpisodicReward(gymnasium.Wrapper, RecordConstructorArgs):
    """Replaces the reward by the sum of the episode's rewards at its last step, and by 0 before.

    `info["true_reward"]` is the true reward of each step. This must be the outermost wrapper that changes rewards or ends episodes.

    >>> environment = EpisodicReward(gymnasium.make("Reacher-v5"))
    >>> _ = environment.reset(seed=0)
    >>> [environment.step(environment.action_space.sample())[1] for _ in range(49)] == [0.0] * 49
    True
    >>> environment.step(environment.action_space.sample())[1] < 0
    True
    """

    def __init__(self, env: gymnasium.Env, score: str | None = None):
        """Wrap an environment.

        Args:
            score: a key of the last step's `info`, whose value replaces the sum of rewards.
        """
        RecordConstructorArgs.__init__(self, score=score)
        gymnasium.Wrapper.__init__(self, env)
        self.score = score
        self._return = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._return = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one step. Raises `LareError` if the reward is not a number, or if the last step's `info` has no score."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        true_reward = convert_output(to_float, reward, "the reward")
        self._return += true_reward
        reward = 0.0
        if terminated or truncated:
            reward = self._return if self.score is None else read_score(info, self.score)
        return observation, reward, terminated, truncated, {**info, TRUE_REWARD: true_reward}


def read_score(info: Mapping[str, Any], key: str) -> float:
    """Return the score of an episode from the `info` of its last step. Raises `LareError` if it is not a finite number."""
    if key not in info:
        raise LareError(f"the info of the last step has no {key!r}: it has {', '.join(map(repr, info)) or 'nothing'}")
    try:
        score = to_float(info[key])
    except ValueError as error:
        raise LareError(f"info[{key!r}] of the last step {error}") from None
    if not math.isfinite(score):
        raise LareError(f"info[{key!r}] of the last step is {score}, which is not finite")
    return score
