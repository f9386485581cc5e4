"""The episodic setting: nothing is paid until the episode ends, and then everything at once."""

from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

TRUE_REWARD = "true_reward"
"""Where `info` keeps the reward of the step."""


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

    def __init__(self, env: gymnasium.Env):
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        self.so_far = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.so_far = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.so_far += float(reward)
        paid = self.so_far if terminated or truncated else 0.0
        return observation, paid, terminated, truncated, {**info, TRUE_REWARD: float(reward)}
