"""The episodic setting: the whole return of an episode is paid at its last step, and nothing before."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from lare_rl.errors import LareError, shortened

TRUE_REWARD = "true_reward"
"""The key of `info` for the true reward of the step."""


class EpisodicReward(gymnasium.Wrapper, RecordConstructorArgs):
    """Pays 0 until the last step of an episode, and there the sum of all its rewards.

    The true reward of each step stays in `info["true_reward"]`. It must be the outermost wrapper that changes rewards
    or ends episodes.

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
            env: the environment.
            score: a key of the last step's `info` that holds the score of the episode, which is paid instead of the sum.
        """
        RecordConstructorArgs.__init__(self, score=score)
        gymnasium.Wrapper.__init__(self, env)
        self.score = score
        self.so_far = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.so_far = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step. Raises `LareError` if a score must be paid, and the last step's `info` has none."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.so_far += float(reward)
        paid = 0.0
        if terminated or truncated:
            paid = self.so_far if self.score is None else score_in(info, self.score)
        return observation, paid, terminated, truncated, {**info, TRUE_REWARD: float(reward)}


def score_in(info: Mapping[str, Any], key: str) -> float:
    """The score of an episode, from the `info` of its last step.

    Raises:
        LareError: it is missing or is not a finite number.
    """
    if key not in info:
        raise LareError(f"the info of the last step has no {key!r}: it has {', '.join(map(repr, info)) or 'nothing'}")
    try:
        score = float(info[key])
    except (TypeError, ValueError):
        raise LareError(f"info[{key!r}] of the last step is {shortened(info[key])}, which is not a number") from None
    if not math.isfinite(score):
        raise LareError(f"info[{key!r}] of the last step is {score}: a score must be finite")
    return score
