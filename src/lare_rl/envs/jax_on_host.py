"""A `JaxEnv` that steps on the host, to verify a function or to inspect the environment."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lare_rl.envs.interface import JaxEnv, Timestep
from lare_rl.errors import LareError


class OnHost:
    """A `JaxEnv` as a `HostEnv`."""

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
        """Not available: `JaxEnv.frames` draws such environments."""
        raise LareError("an environment in JAX cannot be rendered step by step: its frames() draws whole episodes")

    def close(self) -> None:
        """There is nothing to close."""
