"""Algorithms that consume whole episodes: sample episodes, relabel them by the newest decoder, and update.

QMIX and VDN work like this. There is one update for every `update_every` finished episodes. The team has one reward for each step: the
mean over its agents that are alive. The mixer's input is the global state or, without one, all observations side by side. It is
standardised by its running mean and deviation (PyMARL2 does not standardise it, because its environments return scaled states).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Metrics, Sequences
from lare_rl.algorithms.registry import SequenceSettings
from lare_rl.config.train_config import TrainConfig
from lare_rl.data import replay
from lare_rl.data.layouts import lay_out_padded
from lare_rl.data.replay import Replay
from lare_rl.data.sampling import EpisodeSample, sample_distinct_episodes
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import EnvSpec, team_mean, with_available_action
from lare_rl.nn.masks import select, step_mask
from lare_rl.nn.normalise import RunningMeanStd, empty_mean_std, standardise_unless_empty, update_mean_std
from lare_rl.training.decoder_fits import sample_credit, update_decoders
from lare_rl.training.decoder_inputs import alive_agents
from lare_rl.training.episodes import Decoders
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import rewards
from lare_rl.util.rounding import ceil_div

__all__ = ["Actor", "SequenceState", "get_actor", "init", "train_step"]

Updated = tuple[Any, Decoders]
"""What an update changes: the `networks` of `SequenceState`, and the decoders."""

MIN_STEPS_TO_SHORTEN = 32
"""If the longest possible episode has fewer steps, batches have its length: the update is compiled once for each length, and a shorter
batch of short episodes saves little time."""


class SequenceState(NamedTuple):
    """The state of the algorithm, and what the training loop adds to it."""

    networks: Any
    """The state that the algorithm's `init` returns: networks, target networks and optimizer."""
    mixer_statistics: RunningMeanStd
    """Running statistics of the mixer's input."""
    n_due: Int[Array, ""]
    """The number of updates that were due so far: one for every `update_every` episodes, also if there were too few episodes for a
    batch, and the update was not made."""


class Actor(NamedTuple):
    """What is needed to act: the agents' network, and the probability of a random action."""

    agent: Any
    epsilon: Float[Array, ""]


def _settings(config: TrainConfig) -> SequenceSettings:
    assert isinstance(config.hyperparameters, SequenceSettings)
    return config.hyperparameters


def _mixer_input(
    observation: Float[Array, "*batch agents observation"], state: Float[Array, "*batch state"], config: TrainConfig
) -> Float[Array, "*batch mixer_input"]:
    """Return the global state or, if there is none, all observations side by side."""
    return state if config.env.state_size else observation.reshape(*observation.shape[:-2], -1)


def init(key: PRNGKeyArray, config: TrainConfig) -> SequenceState:
    """Return the untrained algorithm."""
    env = config.env
    input_size = env.state_size or env.n_agents * env.observation_size
    algorithm = config.algorithm.load()
    state = algorithm.init(key, env.n_agents, env.observation_size, env.action_size, input_size, _settings(config))
    return SequenceState(state, empty_mean_std(input_size), jnp.zeros((), jnp.int32))


def get_actor(state: SequenceState, env_steps: int | Int[Array, ""], config: TrainConfig) -> Actor:
    """Return the actor after `env_steps` environment steps, of one seed or of all."""
    algorithm = config.algorithm.load()
    epsilon = algorithm.epsilon(env_steps, _settings(config))
    # `n_due` has the shape (seeds,), or () for one seed.
    return Actor(algorithm.get_actor(state.networks), jnp.full(state.n_due.shape, epsilon))


def train_step(
    learner: Learner, steps: Trajectory, keys: Key[Array, " seeds"], env_steps: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, Metrics]:
    """Make the updates that are due, once there are enough episodes for a batch.

    The arguments have a leading axis of seeds, because the batches of all seeds have the same length: the smallest allowed
    length that fits the longest sampled episode of any seed.
    """
    settings, n_due_before = _settings(config), learner.algorithm.n_due
    n_due = jnp.sum(learner.replay.current_episode, axis=1) // settings.update_every
    has_batch = jnp.sum(jax.vmap(replay.n_stored_episodes)(learner.replay), axis=1) >= settings.batch_size
    n_updates = jnp.where(has_batch, n_due - n_due_before, 0)
    statistics = jax.vmap(partial(_observe_states, config=config))(learner.algorithm.mixer_statistics, steps)
    learner = learner._replace(algorithm=learner.algorithm._replace(mixer_statistics=statistics, n_due=n_due))
    batch_lengths = _batch_lengths(config)
    update_functions = [jax.vmap(partial(_update_seed, config=config, n_steps=length)) for length in batch_lengths]

    def make_update(i: Int[Scalar, ""], networks: Any, decoders: Decoders) -> tuple[Updated, Metrics]:
        current = learner._replace(algorithm=learner.algorithm._replace(networks=networks), decoders=decoders)
        pairs = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, i)))(keys)
        sample_keys, update_keys = jnp.unstack(pairs, axis=1)
        sample = partial(sample_distinct_episodes, count=settings.batch_size)
        episodes = jax.vmap(sample)(current.replay, sample_keys)
        longest = jnp.max(episodes.length * (episodes.mask > 0))
        function_index = jnp.searchsorted(jnp.asarray(batch_lengths), longest)  # the first length that is not smaller
        update_number = n_due_before + i + 1
        return jax.lax.switch(function_index, update_functions, current, episodes, update_keys, update_number)

    def update(i: Int[Scalar, ""], carry: tuple[Updated, Metrics]) -> tuple[Updated, Metrics]:
        before, sums = carry
        updated, metrics = make_update(i, *before)
        is_due = i < n_updates  # of each seed
        sums = {name: sums[name] + jnp.where(is_due, values, 0) for name, values in metrics.items()}
        return select(is_due, updated, before), sums

    start = learner.algorithm.networks, learner.decoders
    _, metric_shapes = jax.eval_shape(make_update, jnp.int32(0), *start)
    zeros = jax.tree.map(jnp.zeros_like, metric_shapes)
    (networks, decoders), sums = jax.lax.fori_loop(0, jnp.max(n_updates), update, (start, zeros))
    learner = learner._replace(algorithm=learner.algorithm._replace(networks=networks), decoders=decoders)
    metrics = {name: total / n_updates for name, total in sums.items()}  # NaN where there was no update
    return learner, metrics | {"algorithm/updates": n_updates.astype(jnp.float32)}


def _batch_lengths(config: TrainConfig) -> list[int]:
    """Return the allowed lengths of a batch: a quarter, a half and all of the steps of the longest possible episode."""
    longest = config.env.max_steps
    if config.env.fixed_length or longest < MIN_STEPS_TO_SHORTEN:
        return [longest]
    return sorted({ceil_div(longest, 4), ceil_div(longest, 2), longest})


def _observe_states(statistics: RunningMeanStd, steps: Trajectory, config: TrainConfig) -> RunningMeanStd:
    """Update the running statistics of the mixer's input by new steps."""
    timestep = steps.next_timestep
    rows = _mixer_input(timestep.observation, timestep.state, config)
    return update_mean_std(statistics, rows)


def _update_seed(
    learner: Learner,
    episodes: EpisodeSample,
    key: PRNGKeyArray,
    update_number: Int[Scalar, ""],
    config: TrainConfig,
    n_steps: int,
) -> tuple[Updated, Metrics]:
    """Update the decoder and then the algorithm of one seed. `update_number` counts the updates that were due, from 1."""
    sample_key, fit_key = jax.random.split(key)
    decoders, metrics = learner.decoders, {}
    if config.joint_fit:
        samples = sample_credit(learner.replay, sample_key, 1, config)
        sample = jax.tree.map(lambda leaf: leaf[0], samples)  # without the axis of updates
        decoders, metrics = update_decoders(learner.decoders, learner.replay, sample, fit_key, config)
    state, settings = learner.algorithm, _settings(config)
    batch = _sequences(learner.replay, episodes, n_steps, decoders, state.mixer_statistics, config)
    n_episodes = update_number * settings.update_every
    # Copy if a multiple of `target_every` lies among the newest `update_every` episodes.
    copy_target = n_episodes // settings.target_every > (n_episodes - settings.update_every) // settings.target_every
    networks, algorithm_metrics = config.algorithm.load().update(state.networks, batch, copy_target, settings)
    return (networks, decoders), metrics | algorithm_metrics


def _sequences(
    buffer: Replay,
    episodes: EpisodeSample,
    n_steps: int,
    decoders: Decoders,
    mixer_statistics: RunningMeanStd,
    config: TrainConfig,
) -> Sequences:
    """Return episodes with the method's rewards. Each is padded to `n_steps` steps by copies of its last step."""
    steps = replay.read(buffer, episodes.steps(lay_out_padded(episodes.length, n_steps).step))
    mask = step_mask(episodes.length, n_steps) * episodes.mask[:, None]
    reward = rewards(steps, decoders, config)

    def all_timesteps(name: str) -> Array:
        """Return the column at all n_steps + 1 time steps: before the first step, and after each step."""
        return jnp.concatenate([steps.columns[name][:, :1], steps.next_columns[name]], axis=1)

    observation = all_timesteps("observation")
    state = all_timesteps("state") if config.env.state_size else jnp.zeros((*observation.shape[:2], 0))
    return Sequences(
        observation=observation,
        state=standardise_unless_empty(mixer_statistics, _mixer_input(observation, state, config)),
        available=_available_actions(all_timesteps, observation.shape[:-1], config.env),
        action=steps.columns["action"],
        reward=mask * team_mean(reward, alive_agents(steps, config), config.env.teams[0]),
        done=episodes.mask[:, None] * (jnp.arange(n_steps) == episodes.length[:, None] - 1),
        mask=mask,
    )


def _available_actions(
    all_timesteps: Callable[[str], Array], shape: tuple[int, ...], env: EnvSpec
) -> Bool[Array, "episodes time_steps agents action"]:
    """Return the available actions of agents at some time steps of this shape. One that has left can only choose the first action."""
    if env.masks_actions:
        return all_timesteps("available")
    available = jnp.ones((*shape, env.action_size), bool)
    return with_available_action(available & all_timesteps("alive")[..., None]) if env.agents_leave else available
