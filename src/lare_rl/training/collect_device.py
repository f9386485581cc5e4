"""Collects from an environment of pure functions: the policy and all environments of all seeds in one compiled call."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from lare_rl.algorithms.registry import Noise
from lare_rl.config.train_config import TrainConfig
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.env_errors import check_group
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import JaxEnv, Timestep, team_mean, to_env_action
from lare_rl.envs.vec_env import check_jax_env, check_lengths
from lare_rl.nn.masks import select
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.compile_cache import cache_by_value
from lare_rl.training.evaluation import EpisodeBatch, Evaluation
from lare_rl.training.policy import Policy, init_memory, make_policy
from lare_rl.training.seed_axis import jit_over_seeds, seed_sharding
from lare_rl.training.streams import Stream, device_noise, stream_keys

__all__ = ["DeviceCollector", "VecEnvState", "collect", "is_reset_cheap", "make_jax_env", "reset", "unroll_on_device"]

MAX_RESET_FLOPS = 2e7
"""If a reset of all environments takes fewer operations, an accelerator makes it with each step, and uses the result where an episode has
ended. It would take longer to ask first whether an episode has ended."""


class VecEnvState(NamedTuple):
    """The state of every environment of every seed, between two steps."""

    state: Any
    timestep: Timestep
    memory: Any
    """The memory of the actors."""
    episode_start: Bool[Array, "seeds envs"]
    """Whether an episode has just begun."""


class DeviceCollector:
    """The environments of a run, if they are pure functions: one compiled call makes an iteration's steps."""

    def __init__(self, env: JaxEnv, config: TrainConfig, seeds: Sequence[int]):
        self.env, self._seeds, self._n_devices, self._group = env, seeds, config.n_devices, config.group
        self._reset, self._collect, self._evaluate = _jit_functions(env, config)
        self.envs: VecEnvState = self._reset(stream_keys(seeds, Stream.TRAINING_EPISODES, 0))

    def collect(self, actor: Any, step: int) -> Trajectory:
        """Return the steps of the iteration that begins at `step`. During the warmup, actions are random."""
        keys = stream_keys(self._seeds, Stream.EXPLORATION, step)
        self.envs, steps = self._collect(self.envs, actor, keys, step)
        return steps

    def evaluate(self, actor: Any, n_episodes: int, number: int = 0) -> Evaluation:
        """Evaluate whole episodes. The same number gives the same initial states; the run's own evaluations use 0.

        Raises `EnvOutputError` if an episode does not end within the time limit.
        """
        keys = stream_keys(self._seeds, Stream.EVALUATION_EPISODES, number)
        evaluation, ended = jax.device_get(self._evaluate(actor, keys, n_episodes=n_episodes))
        check_lengths(self.env.spec, evaluation.lengths.ravel(), ended.ravel())
        if self._group is not None:
            for value in np.unique(evaluation.measures[self._group]).tolist():
                check_group(value, self._group)
        return evaluation

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the arrays that `restore` needs."""
        leaves = enumerate(jax.tree.leaves(self.envs))
        return {str(i): np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf) for i, leaf in leaves}

    def restore(self, arrays: dict[str, np.ndarray]) -> tuple[Bool[np.ndarray, "seeds envs"], list[str]]:
        """Restore the environments. Return which episodes were dropped, and messages, as on the host: here there are none.

        Raises `ValueError` or `KeyError` if the arrays are not those of these environments.
        """
        leaves, structure = jax.tree.flatten(self.envs)
        saved: list[Any] = [arrays[str(i)] for i in range(len(leaves))]
        for i, leaf in enumerate(leaves):
            if _is_key(leaf):
                saved[i] = jax.random.wrap_key_data(saved[i], impl=jax.random.key_impl(leaf))
            if (saved[i].shape, saved[i].dtype) != (leaf.shape, leaf.dtype):
                raise ValueError(
                    f"array {i} of the environments is {saved[i].dtype}{saved[i].shape}, not {leaf.dtype}{leaf.shape}"
                )
        self.envs = jax.device_put(jax.tree.unflatten(structure, saved), seed_sharding(self._n_devices))
        return np.zeros(self.envs.episode_start.shape, bool), []


def _is_key(leaf: Array) -> bool:
    """Return whether an array holds random keys, as the state of an environment may."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def unroll_on_device(
    env: JaxEnv,
    actor: Any,
    keys: Key[Array, " seeds"],
    n_episodes: int,
    config: TrainConfig,
    deterministic: bool,
    act: Policy | None = None,
) -> EpisodeBatch:
    """Play whole episodes of a policy, each from a different initial state. `act` replaces the policy of training."""
    act = act or make_policy(config, deterministic)
    reset_keys, step_keys = jnp.unstack(_split_keys(keys, 2), axis=1)
    envs = reset(env, reset_keys, n_episodes, config)

    def body(carry: tuple[VecEnvState, Array], randomness: tuple[Any, Any]) -> tuple[Any, EpisodeBatch]:
        envs, running = carry
        envs, steps = _step(env, envs, actor, *randomness, config, act)
        return (envs, running & ~steps.ended), EpisodeBatch(steps, running, envs.state)

    keys = jnp.swapaxes(_split_keys(step_keys, config.env.max_steps), 0, 1)
    start = envs, jnp.ones_like(envs.episode_start)
    return jax.lax.scan(body, start, _draw(keys, n_episodes, config, deterministic))[1]


@cache_by_value
def _jit_functions(env: JaxEnv, config: TrainConfig) -> tuple[Callable[..., Any], ...]:
    jit = partial(jit_over_seeds, n_devices=config.n_devices)
    return (
        jit(partial(reset, env, n_envs=config.n_envs, config=config)),
        jit(partial(collect, env, config=config), shared=(3,), donate=(0,)),
        jit(partial(_evaluate, env, config=config), static=("n_episodes",)),
    )


def reset(env: JaxEnv, keys: Key[Array, " seeds"], n_envs: int, config: TrainConfig) -> VecEnvState:
    """Begin an episode in `n_envs` environments of each seed."""
    state, timestep = jax.vmap(jax.vmap(env.reset))(_split_keys(keys, n_envs))
    episode_start = jnp.ones((len(keys), n_envs), bool)
    return VecEnvState(state, timestep, init_memory(config, *episode_start.shape), episode_start)


def _draw(
    keys: Key[Array, "time seeds"], n_envs: int, config: TrainConfig, deterministic: bool
) -> tuple[Float[Array, "time seeds envs agents noise"] | None, Key[Array, "time seeds envs"]]:
    """Draw the noise of the policy (None if it is deterministic), and the keys of the environments, for all steps.

    An accelerator needs as long for a single step.
    """

    def draw_step(keys: Key[Array, " seeds"]) -> tuple[Any, Any]:
        noise_keys, env_keys = jnp.unstack(_split_keys(keys, 2), axis=1)
        shape = n_envs, config.env.n_agents, config.noise_size
        noise = None if deterministic else jax.vmap(lambda key: device_noise(key, config.noise, shape))(noise_keys)
        return noise, _split_keys(env_keys, n_envs)

    return jax.vmap(draw_step)(keys)


def _step(
    env: JaxEnv, envs: VecEnvState, actor: Any, noise: Array | None, keys: Array, config: TrainConfig, act: Policy
) -> tuple[VecEnvState, Trajectory]:
    """Step all environments. Episodes that have ended are not reset."""
    timestep = envs.timestep
    action, memory = act(actor, envs.memory, timestep.observation, timestep.available, noise, envs.episode_start)
    env_action = action if config.env.discrete else to_env_action(action, config.env)
    state, next_timestep = jax.vmap(jax.vmap(env.step))(envs.state, env_action, keys)
    steps = Trajectory(timestep=timestep, action=action, env_action=env_action, next_timestep=next_timestep)
    return VecEnvState(state, next_timestep, memory, jnp.zeros_like(envs.episode_start)), steps


def collect(
    env: JaxEnv,
    envs: VecEnvState,
    actor: Any,
    keys: Key[Array, " seeds"],
    env_steps: int | Int[Array, ""],
    config: TrainConfig,
) -> tuple[VecEnvState, Trajectory]:
    """Make `rollout_steps` steps of every environment. When an episode ends, the next one begins.

    `env_steps` is the number of steps before. During the warmup, actions are random.
    """
    act, n_envs = _exploration_policy(env_steps, config), config.n_envs

    def body(envs: VecEnvState, randomness: tuple[Any, ...]) -> tuple[VecEnvState, Trajectory]:
        noise, env_keys, reset_keys = randomness
        envs, steps = _step(env, envs, actor, noise, env_keys, config, act)

        def reset_ended(envs: VecEnvState) -> VecEnvState:
            fresh = reset(env, reset_keys, n_envs, config)
            state, timestep = select(steps.ended, (fresh.state, fresh.timestep), (envs.state, envs.timestep))
            return VecEnvState(state, timestep, envs.memory, episode_start=steps.ended)

        if config.resets_with_steps:
            return reset_ended(envs), steps
        return jax.lax.cond(jnp.any(steps.ended), reset_ended, lambda unchanged: unchanged, envs), steps

    keys = jnp.swapaxes(_split_keys(keys, config.rollout_steps), 0, 1)
    step_keys, reset_keys = jnp.unstack(jax.vmap(partial(_split_keys, number=2))(keys), axis=2)
    randomness = (*_draw(step_keys, n_envs, config, deterministic=False), reset_keys)
    envs, steps = jax.lax.scan(body, envs, randomness)
    return envs, jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), steps)


def _exploration_policy(env_steps: int | Int[Array, ""], config: TrainConfig) -> Policy:
    """Return the policy that collects. During the warmup, its actions are random: evenly distributed between the bounds."""
    policy = make_policy(config, deterministic=False)
    if not config.warmup:
        return policy
    assert config.noise is Noise.NORMAL

    def act(actor: Any, memory: Any, observation: Array, available: Array, noise: Array, episode_start: Array) -> Any:
        action, memory = policy(actor, memory, observation, available, noise, episode_start)
        uniform = jax.lax.erf(noise / math.sqrt(2))  # the distribution function of the noise, scaled to -1 to 1
        return jnp.where(env_steps < config.warmup, uniform, action), memory

    return act


@cache_by_value
def make_jax_env(task: TaskSpec) -> JaxEnv:
    """Make an environment of pure functions. The same object serves all runs, so that their collectors compile once.

    Raises:
        LareError: the environment cannot be made, or its arrays do not have the shapes of its spec.
    """
    env = make_env(task)
    assert isinstance(env, JaxEnv)
    check_jax_env(env, task.environment)
    return env


def is_reset_cheap(env: JaxEnv, n_envs: int) -> bool:
    """Return whether an accelerator should reset all environments with each step, by XLA's estimate of the operations."""
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), n_envs))
    cost = jax.jit(jax.vmap(env.reset)).lower(keys).cost_analysis()
    return float((cost or {}).get("flops", math.inf)) < MAX_RESET_FLOPS


def _evaluate(
    env: JaxEnv, actor: Any, keys: Key[Array, " seeds"], *, n_episodes: int, config: TrainConfig
) -> tuple[Evaluation, Bool[Array, "seeds episodes"]]:
    """Return the results of whole episodes, and whether each has ended."""
    steps, mask, _ = unroll_on_device(env, actor, keys, n_episodes, config, config.deterministic_evaluation)
    reward = jnp.where(mask[..., None], steps.next_timestep.reward, 0)  # after the end, an environment may return NaN
    returns = [team_mean(reward, steps.timestep.alive, team).sum(axis=0) for team in config.env.teams]
    summed_returns = [reward[..., team.agents].sum(axis=(0, -1)) for team in config.env.teams]
    last = mask & steps.ended
    measures = {name: jnp.where(last, values, 0.0).sum(axis=0) for name, values in steps.next_timestep.measures.items()}
    returns, summed_returns = (jnp.stack(values, axis=-1) for values in (returns, summed_returns))
    return Evaluation(returns, summed_returns, mask.sum(axis=0), measures), last.any(axis=0)


def _split_keys(keys: Key[Array, " seeds"], number: int) -> Key[Array, "seeds {number}"]:
    return jax.vmap(lambda key: jax.random.split(key, number))(keys)
