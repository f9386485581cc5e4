"""Collecting from an environment of pure functions: the policy and all environments of all seeds in one compiled call."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key

from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import JaxEnv, Timestep, env_action, team_mean
from lare_rl.training.compiled import acting, new_memory
from lare_rl.training.evaluation import Evaluation
from lare_rl.training.static_config import TrainConfig
from lare_rl.training.streams import Stream, device_noise, stream_keys


class Worlds(NamedTuple):
    """The state of every environment of every seed, between two steps."""

    state: Any
    shown: Timestep
    memory: Any
    """The memory of the actors."""
    new: Bool[Array, "seeds envs"]
    """Whether an episode has just begun."""


class Played(NamedTuple):
    """Whole episodes, each from its own initial state: [time seeds episodes ...]."""

    steps: Trajectory
    mask: Bool[Array, "time seeds episodes"]
    """Whether the episode had not ended before the step."""
    state: Any
    """The environment's states, after each step."""


def on_all(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, mapped over seeds and environments."""
    return jax.vmap(jax.vmap(function))


def spread(keys: Key[Array, " seeds"], count: int) -> Key[Array, "seeds {count}"]:
    """Keys for the environments of each seed."""
    return jax.vmap(lambda key: jax.random.split(key, count))(keys)


def start(env: JaxEnv, keys: Key[Array, " seeds"], count: int, config: TrainConfig) -> Worlds:
    """Environments at the start of an episode."""
    state, shown = on_all(env.reset)(spread(keys, count))
    new = jnp.ones((len(keys), count), bool)
    return Worlds(state, shown, new_memory(config, *new.shape), new)


def step(
    env: JaxEnv,
    worlds: Worlds,
    actor: Any,
    keys: Key[Array, " seeds"],
    config: TrainConfig,
    greedy: bool,
    act: Callable[..., tuple[Array, Any]],
) -> tuple[Worlds, Trajectory]:
    """One step of all environments. An episode that has ended is not reset here."""
    count = worlds.new.shape[1]
    noise_keys, keys = jnp.unstack(spread(keys, 2), axis=1)
    noise = None
    if not greedy:
        shape = count, config.env.agents, config.noise_size
        noise = jax.vmap(lambda key: device_noise(key, config.noise, shape))(noise_keys)
    before = worlds.shown
    action, memory = act(actor, worlds.memory, before.observation, before.available, noise, worlds.new)
    taken = action if config.env.discrete else env_action(action, config.env)
    state, after = on_all(env.step)(worlds.state, taken, spread(keys, count))
    return Worlds(state, after, memory, jnp.zeros_like(worlds.new)), Trajectory(before, action, taken, after)


def collect(
    env: JaxEnv, worlds: Worlds, actor: Any, keys: Key[Array, " seeds"], config: TrainConfig
) -> tuple[Worlds, Trajectory]:
    """`rollout_steps` steps of every environment. When an episode ends, the next one begins."""

    def one(worlds: Worlds, keys: Key[Array, " seeds"]) -> tuple[Worlds, Trajectory]:
        step_keys, reset_keys = jnp.unstack(spread(keys, 2), axis=1)
        worlds, steps = step(env, worlds, actor, step_keys, config, greedy=False, act=acting(config, greedy=False))

        def begin(worlds: Worlds) -> Worlds:
            fresh = start(env, reset_keys, worlds.new.shape[1], config)

            def choose(new: Array, old: Array) -> Array:
                return jnp.where(steps.ended.reshape(*steps.ended.shape, *[1] * (old.ndim - 2)), new, old)

            state, shown = jax.tree.map(choose, (fresh.state, fresh.shown), (worlds.state, worlds.shown))
            return Worlds(state, shown, worlds.memory, steps.ended)

        # A reset costs as much as a step, so it is skipped if no episode has ended.
        return jax.lax.cond(jnp.any(steps.ended), begin, lambda worlds: worlds, worlds), steps

    keys = jnp.swapaxes(spread(keys, config.rollout_steps), 0, 1)
    worlds, steps = jax.lax.scan(one, worlds, keys)
    return worlds, jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), steps)


def play(
    env: JaxEnv,
    actor: Any,
    keys: Key[Array, " seeds"],
    count: int,
    config: TrainConfig,
    greedy: bool,
    act: Callable[..., tuple[Array, Any]] | None = None,
) -> Played:
    """Whole episodes of a policy, each from its own initial state. `act`, if given, is called instead of training's `acting`."""
    act = act or acting(config, greedy)
    start_keys, step_keys = jnp.unstack(spread(keys, 2), axis=1)
    worlds = start(env, start_keys, count, config)

    def one(
        carry: tuple[Worlds, Bool[Array, "seeds episodes"]], keys: Key[Array, " seeds"]
    ) -> tuple[tuple[Worlds, Bool[Array, "seeds episodes"]], Played]:
        worlds, running = carry
        worlds, steps = step(env, worlds, actor, keys, config, greedy, act)
        return (worlds, running & ~steps.ended), Played(steps, running, worlds.state)

    keys = jnp.swapaxes(spread(step_keys, config.env.max_steps), 0, 1)
    return jax.lax.scan(one, (worlds, jnp.ones_like(worlds.new)), keys)[1]


def evaluate(env: JaxEnv, actor: Any, keys: Key[Array, " seeds"], count: int, config: TrainConfig) -> tuple[Any, ...]:
    """The results of whole episodes of the policy: the parts of an `Evaluation`."""
    played = play(env, actor, keys, count, config, config.greedy)
    steps, mask = played.steps, played.mask
    reward = steps.after.reward * mask[..., None]
    returns = [team_mean(reward, steps.before.alive, team).sum(axis=0) for team in config.env.teams]
    sums = [reward[..., team.agents].sum(axis=(0, -1)) for team in config.env.teams]
    last = mask & steps.ended
    return (
        jnp.stack(returns, axis=-1),
        jnp.stack(sums, axis=-1),
        mask.sum(axis=0),
        {name: (values * last).sum(axis=0) for name, values in steps.after.measures.items()},
    )


class DeviceCollector:
    """The environments of a run, if they are pure functions: one compiled call makes an iteration's steps."""

    def __init__(self, env: JaxEnv, config: TrainConfig, seeds: Sequence[int]):
        self.seeds = seeds
        self.collecting = jax.jit(partial(collect, env, config=config), donate_argnums=0)
        self.evaluating = jax.jit(partial(evaluate, env, config=config), static_argnums=2)
        begin = jax.jit(partial(start, env, count=config.environments, config=config))
        self.worlds: Worlds = begin(stream_keys(seeds, Stream.TRAINING_EPISODES, 0))

    def collect(self, actor: Any, step: int) -> Trajectory:
        """The steps of the iteration that begins at this step."""
        self.worlds, steps = self.collecting(self.worlds, actor, stream_keys(self.seeds, Stream.EXPLORATION, step))
        return steps

    def evaluate(self, actor: Any, episodes: int, number: int = 0) -> Evaluation:
        """Evaluate whole episodes. The same number gives the same initial states; the run's own evaluations use 0."""
        keys = stream_keys(self.seeds, Stream.EVALUATION_EPISODES, number)
        return Evaluation(*jax.device_get(tuple(self.evaluating(actor, keys, episodes))))

    def saved(self) -> dict[str, np.ndarray]:
        """The current worlds."""
        return {str(place): np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(self.worlds))}

    def restore(self, saved: dict[str, np.ndarray]) -> tuple[Bool[np.ndarray, "seeds envs"], list[str]]:
        """Restore saved worlds. No episode is dropped."""
        leaves, structure = jax.tree.flatten(self.worlds)
        self.worlds = jax.device_put(jax.tree.unflatten(structure, [saved[str(i)] for i in range(len(leaves))]))
        return np.zeros(self.worlds.new.shape, bool), []

    def close(self) -> None:
        """There is nothing to close."""
