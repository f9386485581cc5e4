"""Represents all spaces as rows of numbers: observations are flattened, discrete actions are encoded one-hot."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import FlattenObservation
from jaxtyping import Float


class OneHot(Box):
    """One of n actions, encoded one-hot. Any other row stands for the action at its largest number."""

    def __init__(self, n: int, start: int = 0, seed: int | np.random.Generator | None = None):
        super().__init__(0, 1, (n,), np.float32, seed)
        self.start = start
        """The number of the first action."""

    def sample(self, *args: Any, **kwargs: Any) -> Float[np.ndarray, " n"]:
        return self.chosen(super().sample(*args, **kwargs))

    def chosen(self, row: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The one-hot row of the action that a row stands for."""
        return np.eye(len(row), dtype=np.float32)[int(np.argmax(row))]

    def number(self, row: Float[np.ndarray, " n"]) -> int:
        """The number that the environment gives to the action of a row."""
        return self.start + int(np.argmax(row))


class OneHotAction(gymnasium.ActionWrapper, RecordConstructorArgs):
    """Makes an environment with discrete actions accept one-hot rows."""

    def __init__(self, env: gymnasium.Env):
        RecordConstructorArgs.__init__(self)  # required by Gymnasium to make the same environment again
        super().__init__(env)
        assert isinstance(env.action_space, Discrete)
        self.choice = OneHot(int(env.action_space.n), int(env.action_space.start))
        self.action_space = self.choice

    def action(self, action: Float[np.ndarray, " n"]) -> int:
        return self.choice.number(action)


def as_rows(environment: gymnasium.Env) -> gymnasium.Env:
    """The environment with observations and actions as rows of numbers, as far as this is possible."""
    if isinstance(environment.action_space, Discrete):
        environment = OneHotAction(environment)
    observations = environment.observation_space
    if observations.is_np_flattenable and not (isinstance(observations, Box) and len(observations.shape) == 1):
        environment = FlattenObservation(environment)
    return environment
