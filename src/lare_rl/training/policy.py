"""The policy of a run, whatever data its algorithm consumes: untrained, compiled, and on the host with NumPy.

A policy is a function of the actor, its memory, the observation, the available actions, the noise (None: it acts without noise) and which
episodes have just begun. It returns the action and the new memory. Only QMIX and VDN have a memory.

On the host, a small network acts faster with NumPy than on an accelerator, which needs two transfers and a launch for each step. The
weights are copied once for many steps.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lare_rl.algorithms.registry import Consumes
from lare_rl.config.train_config import TrainConfig
from lare_rl.nn.masks import select
from lare_rl.training import sequences
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.numpy_program import UnsupportedOperationError, to_numpy
from lare_rl.training.seed_axis import jit_over_seeds
from lare_rl.training.streams import host_noise, keys_shape

__all__ = [
    "HostPolicy",
    "Policy",
    "act",
    "actor_shape",
    "compile_policy",
    "draw_noise",
    "get_actor",
    "init_algorithm",
    "init_host_memory",
    "init_memory",
    "make_host_policy",
    "make_policy",
    "policy_input",
]

Policy = Callable[..., tuple[Float[Array, "seeds envs agents action"], Any]]
HostPolicy = Callable[..., tuple[Float[np.ndarray, "seeds envs agents action"], Any]]
"""As `Policy`, of NumPy arrays and without the actor."""


def init_algorithm(key: PRNGKeyArray, config: TrainConfig) -> Any:
    """Return the untrained state of a run's algorithm."""
    env, algorithm, settings = config.env, config.algorithm.load(), config.hyperparameters
    match config.consumes:
        case Consumes.TRANSITIONS:
            return algorithm.init(key, env.observation_size, env.action_size, settings)
        case Consumes.ROLLOUTS:
            # Several teams have different policies, in one network that sees the agent's number.
            input_size = env.observation_size + (env.n_agents if len(env.teams) > 1 else 0)
            return algorithm.init(key, input_size, env.action_size, env.discrete, settings)
        case Consumes.SEQUENCES:
            return sequences.init(key, config)


def get_actor(state: Any, env_steps: int | Int[Array, ""], config: TrainConfig) -> Any:
    """Return the actor after `env_steps` environment steps, from the algorithm's state of one seed or of all."""
    if config.consumes is Consumes.SEQUENCES:
        return sequences.get_actor(state, env_steps, config)
    return config.algorithm.load().get_actor(state)


def init_memory(config: TrainConfig, *lead: int) -> Any:
    """Return the memory of actors before the first step of an episode, for seeds and environments of shape `lead`."""
    if config.consumes is not Consumes.SEQUENCES:
        return ()
    env = config.env
    memory = config.algorithm.load().init_memory((env.n_agents,), env.action_size, config.hyperparameters)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*lead, *leaf.shape)), memory)


def policy_input(
    observation: Float[Array, "*batch agents observation"], config: TrainConfig
) -> Float[Array, "*batch agents policy_input"]:
    """Return the input of the networks of PPO: the observation and, with several teams, the agent's one-hot number."""
    if len(config.env.teams) == 1:
        return observation
    n_agents = config.env.n_agents
    one_hot = jnp.broadcast_to(jnp.eye(n_agents), (*observation.shape[:-1], n_agents))
    return jnp.concatenate([observation, one_hot], axis=-1)


def act(
    actor: Any,
    memory: Any,
    observation: Float[Array, "*batch agents observation"],
    available: Bool[Array, "*batch agents action"],
    noise: Float[Array, "*batch agents noise"] | None,
    config: TrainConfig,
) -> tuple[Float[Array, "*batch agents action"], Any]:
    """Return the actions of one seed's policy, and its new memory."""
    algorithm, settings = config.algorithm.load(), config.hyperparameters
    match config.consumes:
        case Consumes.SEQUENCES:
            return algorithm.act(actor.agent, memory, observation, available, noise, actor.epsilon)
        case Consumes.ROLLOUTS:
            inputs = policy_input(observation, config), available if config.env.masks_actions else None
            action = algorithm.act(actor, *inputs) if noise is None else algorithm.explore(actor, *inputs, noise)
        case Consumes.TRANSITIONS if noise is None:
            action = algorithm.act(actor, observation)
        case Consumes.TRANSITIONS:
            action = algorithm.explore(actor, observation, noise, settings)
    return action, memory


def make_policy(config: TrainConfig, deterministic: bool) -> Policy:
    """Return the policy of all seeds. If `deterministic`, its noise must be None. Its memory is reset where an episode has just begun."""

    def act_in_envs(
        actor: Any,
        memory: Any,
        observation: Array,
        available: Array,
        noise: Array | None,
        episode_start: Bool[Array, " envs"],
    ) -> tuple[Array, Any]:
        memory = select(episode_start, init_memory(config), memory)
        return act(actor, memory, observation, available, noise, config)

    return jax.vmap(act_in_envs, in_axes=(0, 0, 0, 0, None if deterministic else 0, 0))


@cache_by_value
def compile_policy(config: TrainConfig, deterministic: bool) -> Policy:
    """Return the policy of `make_policy`, compiled."""
    return jit_over_seeds(make_policy(config, deterministic), config.n_devices)


def actor_shape(config: TrainConfig, n_seeds: int) -> Any:
    """Return an actor with shapes instead of arrays."""

    def init_actor(keys: Any) -> Any:
        return get_actor(jax.vmap(partial(init_algorithm, config=config))(keys), 0, config)

    return jax.eval_shape(init_actor, keys_shape(n_seeds))


def make_host_policy(config: TrainConfig, actor: Any, n_envs: int, *, deterministic: bool) -> HostPolicy:
    """Return the policy of all seeds, each in `n_envs` environments, with the weights that the actor has now."""
    bind = _translate_policy(config, len(jax.tree.leaves(actor)[0]), n_envs, deterministic)
    if bind is not None:
        return bind(jax.tree.map(np.array, jax.device_get(actor)))
    policy = compile_policy(config, deterministic)
    return lambda *inputs: jax.device_get(policy(actor, *inputs))


@cache_by_value
def _translate_policy(
    config: TrainConfig, n_seeds: int, n_envs: int, deterministic: bool
) -> Callable[[Any], HostPolicy] | None:
    """Return a function from the actor to the policy as a NumPy program, or None if an operation cannot be translated."""
    env, lead = config.env, (n_seeds, n_envs)

    def shape(*sizes: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*lead, *sizes), dtype)

    memory = jax.eval_shape(lambda: init_memory(config, *lead))
    observation, available = shape(env.n_agents, env.observation_size), shape(env.n_agents, env.action_size, dtype=bool)
    noise = None if deterministic else shape(env.n_agents, config.noise_size)
    inputs = memory, observation, available, noise, shape(dtype=bool)
    try:
        return to_numpy(make_policy(config, deterministic), actor_shape(config, n_seeds), *inputs)
    except UnsupportedOperationError:
        return None


def init_host_memory(config: TrainConfig, *lead: int) -> Any:
    """Return `init_memory` as NumPy arrays."""
    return jax.tree.map(np.array, init_memory(config, *lead))


def draw_noise(
    config: TrainConfig, rngs: Sequence[np.random.Generator], *lead: int
) -> Float[np.ndarray, "seeds *lead agents noise"]:
    """Draw the noise of steps in an array of shape `lead`, by the random generator of each seed."""
    shape = *lead, config.env.n_agents, config.noise_size
    return np.stack([host_noise(rng, config.noise, shape) for rng in rngs])
