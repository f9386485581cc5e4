"""A particle task as one of its agents meets it, as a Gymnasium environment: for whatever knows single agents only.

Latent functions are verified, and specs checked, on the steps of such an environment. What the agent is paid is the mean
of its team's rewards, because that is all that anybody is told when many agents train.
"""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float

from lare.tasks.particles.table import find_particle_task
from lare.tasks.particles.task import ACTIONS
from lare.tasks.spaces import Choice


class OneAgent(gymnasium.Env):
    """The first agent of a team; all others act at random."""

    def __init__(self, task: str, team: int = 0):
        self.task = find_particle_task(task)
        self.team = self.task.teams[team]
        self.observation_space = Box(-np.inf, np.inf, (self.task.observation_size,), np.float32)
        self.action_space = Choice(ACTIONS)
        self.advance, self.begin = jax.jit(self.task.step), jax.jit(self.task.reset)
        self.look, self.judge = jax.jit(self.task.observe), jax.jit(self.task.reward)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.state = self.begin(self.key())
        return self.seen(), {}

    def step(self, action: Float[np.ndarray, " actions"]):
        every = self.np_random.integers(0, ACTIONS, self.task.agents)
        every[self.team.start] = int(np.argmax(action))
        self.state = self.advance(self.state, every, self.key())
        earned = np.asarray(self.judge(self.state))[self.team.start : self.team.stop]
        return self.seen(), float(earned.mean()), False, False, {}

    def key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def seen(self) -> Float[np.ndarray, " observation"]:
        return np.asarray(self.look(self.state))[self.team.start]
