"""An environment of pure functions as one that steps on the host: to verify a function, or to look at it."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lare.errors import LareError
from lare.tasks.env import JaxEnv, Timestep


class OnHost:
    """A `HostEnv` of a `JaxEnv`."""

    def __init__(self, env: JaxEnv):
        self.env, self.spec = env, env.spec
        self.begin, self.advance = jax.jit(env.reset), jax.jit(env.step)

    def reset(self, seed: int) -> Timestep:
        """The first step of an episode."""
        key, self.key = jax.random.split(jax.random.key(seed))
        self.state, timestep = self.begin(key)
        return jax.tree.map(np.asarray, timestep)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        """One step."""
        self.key, key = jax.random.split(self.key)
        self.state, timestep = self.advance(self.state, action, key)
        return jax.tree.map(np.asarray, timestep)

    def render(self) -> Any:
        """Such environments are drawn by their own modules."""
        raise LareError("an environment of pure functions has no window of its own")

    def close(self) -> None:
        """There is nothing to close."""
