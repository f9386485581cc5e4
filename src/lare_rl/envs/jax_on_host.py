"""A `JaxEnv` that steps on the host, to verify a latent function or to inspect the environment."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lare_rl.envs.interface import JaxEnv, Timestep
from lare_rl.errors import LareError

__all__ = ["JaxOnHost"]


class JaxOnHost:
    """A `JaxEnv` as a `HostEnv`."""

    def __init__(self, env: JaxEnv):
        self.env, self.spec = env, env.spec
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)

    def reset(self, seed: int) -> Timestep:
        key, self._key = jax.random.split(jax.random.key(seed))
        self.state, timestep = self._reset(key)
        return jax.tree.map(np.asarray, timestep)

    def step(self, action: Float[np.ndarray, "agents action"]) -> Timestep:
        self._key, key = jax.random.split(self._key)
        self.state, timestep = self._step(self.state, action, key)
        return jax.tree.map(np.asarray, timestep)

    def render(self) -> Any:
        """Refuse: `JaxEnv.frames` draws such environments."""
        raise LareError("an environment in JAX cannot be rendered step by step: call frames() on an episode's states")

    def close(self) -> None: ...
