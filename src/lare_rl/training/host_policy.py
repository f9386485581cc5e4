"""Policies that act on the host, with NumPy, for environments that step there.

A small network acts faster on the CPU than on a card, which needs two transfers and a launch for each step. The weights are copied once
for many steps.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.envs.interface import Timestep
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.compiled import compile_functions, init_memory, policy_function
from lare_rl.training.numpy_program import UnsupportedOperationError, to_numpy
from lare_rl.training.saved_state import actor_shape
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, host_noise, numpy_generator

__all__ = ["EvaluationPolicy", "HostPolicy", "draw_noise", "init_host_memory", "make_policy"]

HostPolicy = Callable[..., tuple[Float[np.ndarray, "seeds envs agents action"], Any]]
"""From memory, observation, available actions, noise (or None), and which episodes are new, to the action and the new memory."""


def make_policy(config: TrainConfig, actor: Any, n_envs: int, *, deterministic: bool) -> HostPolicy:
    """Return the policy of all seeds, each in `n_envs` environments. If `deterministic`, it acts without noise."""
    n_seeds = len(jax.tree.leaves(actor)[0])
    bind = _translate_policy(config, n_seeds, n_envs, deterministic)
    if bind is not None:
        return bind(jax.tree.map(np.array, jax.device_get(actor)))
    functions = compile_functions(config)
    act = functions.act if deterministic else functions.explore

    def act_compiled(*inputs: Any) -> tuple[Float[np.ndarray, "seeds envs agents action"], Any]:
        return jax.device_get(act(actor, *inputs))

    return act_compiled


@cache_by_value
def _translate_policy(
    config: TrainConfig, n_seeds: int, n_envs: int, deterministic: bool
) -> Callable[[Any], HostPolicy] | None:
    """Return the policy as a NumPy program, or None if it has an operation that cannot be translated."""
    env, lead = config.env, (n_seeds, n_envs)

    def shape(*sizes: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*lead, *sizes), dtype)

    memory = jax.eval_shape(lambda: init_memory(config, *lead))
    observation, available = shape(env.n_agents, env.observation_size), shape(env.n_agents, env.action_size, dtype=bool)
    noise = None if deterministic else shape(env.n_agents, config.noise_size)
    inputs = memory, observation, available, noise, shape(dtype=bool)
    try:
        return to_numpy(policy_function(config, deterministic), actor_shape(config, n_seeds), *inputs)
    except UnsupportedOperationError:
        return None


class EvaluationPolicy:
    """The policy of all seeds for whole episodes, which all begin with its first call. It holds the memory of the actors.

    The noise of these episodes is `noise_rows` of that of `n_noise_rows` episodes.
    """

    def __init__(
        self,
        config: TrainConfig,
        actor: Any,
        seeds: Sequence[int],
        noise_rows: Int[np.ndarray, " episodes"],
        n_noise_rows: int,
    ):
        self._config, self._noise_rows, self._n_noise_rows = config, noise_rows, n_noise_rows
        self._policy = make_policy(config, actor, len(noise_rows), deterministic=config.deterministic_evaluation)
        self._memory = init_host_memory(config, len(seeds), len(noise_rows))
        self._rngs = [numpy_generator(seed, Stream.EVALUATION_NOISE, 0) for seed in seeds]

    def __call__(
        self, timestep: Timestep, episode_start: Bool[np.ndarray, "seeds envs"]
    ) -> Float[np.ndarray, "seeds envs agents action"]:
        noise = None
        if not self._config.deterministic_evaluation:
            noise = draw_noise(self._config, self._rngs, self._n_noise_rows)[:, self._noise_rows]
        action, self._memory = self._policy(
            self._memory, timestep.observation, timestep.available, noise, episode_start
        )
        return action


def init_host_memory(config: TrainConfig, *lead: int) -> Any:
    """Return the memory of actors before the first step of an episode, as NumPy arrays."""
    return jax.tree.map(np.array, init_memory(config, *lead))


def draw_noise(
    config: TrainConfig, rngs: Sequence[np.random.Generator], *lead: int
) -> Float[np.ndarray, "seeds *lead agents noise"]:
    """Draw the noise of some steps, which are an array of shape `lead`. `rngs` has a generator for each seed."""
    shape = *lead, config.env.n_agents, config.noise_size
    return np.stack([host_noise(rng, config.noise, shape) for rng in rngs])
