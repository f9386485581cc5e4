"""Steps of some environments as they are collected, before they go into the replay."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lare_rl.envs.interface import AnyArray, EnvSpec, Timestep
from lare_rl.envs.vec_env import empty_batch

__all__ = ["Trajectory", "empty_trajectory"]


class Trajectory(NamedTuple):
    """Consecutive steps of some environments. An episode may continue in the next trajectory.

    `*lead` is the seeds' axis, or nothing within functions of one seed.
    """

    timestep: Timestep
    """What the environment showed before each action: [*lead time envs ...]."""
    action: Float[AnyArray, "*lead time envs agents action"]
    """The policy's action: in [-1, 1], or one-hot."""
    env_action: Float[AnyArray, "*lead time envs agents action"]
    """The same action in the environment's units."""
    next_timestep: Timestep
    """What the environment showed after each action. At the end of an episode this is its final time step, not the next reset."""

    @property
    def ended(self) -> Bool[AnyArray, "*lead time envs"]:
        """Whether the step was the last of its episode: terminated or truncated."""
        return self.next_timestep.terminated | self.next_timestep.truncated


def empty_trajectory(spec: EnvSpec, *shape: int) -> Trajectory:
    """Return steps of zeros, as NumPy arrays. `shape` ends in the numbers of steps and environments."""
    action = np.zeros((*shape, spec.n_agents, spec.action_size), np.float32)
    return Trajectory(
        timestep=empty_batch(spec, *shape),
        action=action,
        env_action=action.astype(spec.action_dtype),
        next_timestep=empty_batch(spec, *shape),
    )
