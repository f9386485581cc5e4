"""Algorithms that consume whole episodes: sample them, relabel them by the newest decoder, update; once for so many new episodes.

QMIX and VDN. The team has one reward for each step: the mean over its agents that are alive. The mixer's input is the global state,
standardised by its running mean and deviation (PyMARL2 does not standardise it; its environments scale it). If there is no global
state, the input is all observations side by side.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, Scalar

from lare_rl.algorithms import qmix
from lare_rl.algorithms.settings import QMIXSettings
from lare_rl.credit.decomposition import Decomposition
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay
from lare_rl.data.sampling import EpisodeSample, sample_distinct_episodes
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import team_mean
from lare_rl.nn.normalise import RunningMeanStd, new_mean_std, observe, standardise_if_known
from lare_rl.nn.recurrent import Recurrent
from lare_rl.training import learner as common
from lare_rl.training.learner import Learner, Paid, sample_credit
from lare_rl.training.static_config import TrainConfig

Measured = dict[str, Float[Array, "*seeds"]]
Updated = tuple[qmix.QMIX, tuple[Decomposition, ...]]


WORTH_CUTTING = 32
"""Batches are cut to shorter lengths only if the longest episode has so many steps: each length is compiled by itself, and little
is saved for shorter episodes."""


class SequenceState(NamedTuple):
    """The state of QMIX, and what its training needs beside it."""

    qmix: qmix.QMIX
    states: RunningMeanStd
    """Running statistics of the mixer's input."""
    done: Int[Array, ""]
    """The number of updates that were due so far, made or not: one for every `update_every` episodes."""


class Actor(NamedTuple):
    """The parts of the state that are needed to act."""

    agent: Recurrent
    epsilon: Float[Array, ""]


def settings_of(config: TrainConfig) -> QMIXSettings:
    """The algorithm's hyperparameters."""
    assert isinstance(config.hyperparameters, QMIXSettings)
    return config.hyperparameters


def mixer_input_size(config: TrainConfig) -> int:
    """Size of the mixer's input."""
    return config.env.state_size or config.env.agents * config.env.observation_size


def mixer_input(shown: Any, config: TrainConfig) -> Float[Array, "*batch state"]:
    """The global state, or all observations side by side."""
    if config.env.state_size:
        return shown["state"]
    observation = shown["observation"]
    return observation.reshape(*observation.shape[:-2], -1)


def init(key: PRNGKeyArray, config: TrainConfig) -> SequenceState:
    """The untrained algorithm."""
    env, size = config.env, mixer_input_size(config)
    made = qmix.init(key, env.agents, env.observation_size, env.action_size, size, settings_of(config))
    return SequenceState(made, new_mean_std(size), jnp.zeros((), jnp.int32))


def actor(learner: Learner, done: int, config: TrainConfig) -> Actor:
    """The parts of the learner that are needed to act, for all seeds."""
    state = learner.algorithm
    return Actor(state.qmix.online.agent, jnp.full(state.done.shape, qmix.epsilon(done, settings_of(config))))


def memory(config: TrainConfig) -> qmix.Memory:
    """The memory of the agents before the first step of an episode."""
    return qmix.no_memory((config.env.agents,), config.env.action_size, settings_of(config))


def act(
    actor: Actor,
    memory: qmix.Memory,
    observation: Float[Array, "*batch agents observation"],
    available: Bool[Array, "*batch agents action"],
    noise: Float[Array, "*batch agents 1+action"] | None,
    config: TrainConfig,
) -> tuple[Float[Array, "*batch agents action"], qmix.Memory]:
    """The available actions of largest value; with noise, sometimes random available ones."""
    return qmix.act(actor.agent, memory, observation, available, noise, actor.epsilon)


def sequences(
    buffer: Replay, episodes: EpisodeSample, steps: int, paid: Paid, states: RunningMeanStd, config: TrainConfig
) -> qmix.Sequences:
    """Drawn episodes with the method's rewards, each padded with its last step to `steps` steps."""
    number = jnp.minimum(jnp.arange(steps), episodes.length[:, None] - 1)
    env = jnp.broadcast_to(episodes.first.env[:, None], number.shape)
    drawn = replay.read(buffer, Index(env, episodes.first.number[:, None] + number))
    here = (jnp.arange(steps) < episodes.length[:, None]) * episodes.mask[:, None]
    reward = common.rewards(drawn, paid, config)

    def at_all_times(name: str) -> Array:
        return jnp.concatenate([drawn.before[name][:, :1], drawn.after[name]], axis=1)

    observation = at_all_times("observation")
    shown = {"observation": observation, "state": at_all_times("state") if config.env.state_size else None}
    shape = (*observation.shape[:-1], config.env.action_size)
    return qmix.Sequences(
        observation=observation,
        state=standardise_if_known(states, mixer_input(shown, config)),
        available=at_all_times("available") if config.env.masks_actions else jnp.ones(shape, bool),
        action=drawn.before["action"],
        reward=here * team_mean(reward, common.alive(drawn, config), config.env.teams[0]),
        terminated=here * (jnp.arange(steps) == episodes.length[:, None] - 1),
        mask=here,
    )


def lengths(config: TrainConfig) -> list[int]:
    """The lengths to which a batch may be cut. The shortest one that holds its longest episode is taken."""
    longest = config.env.max_steps
    if config.env.fixed_length or longest < WORTH_CUTTING:
        return [longest]
    return sorted({-(-longest // 4), -(-longest // 2), longest})


def one_update(
    learner: Learner,
    episodes: EpisodeSample,
    key: PRNGKeyArray,
    number: Int[Scalar, ""],
    config: TrainConfig,
    steps: int,
) -> tuple[Updated, Measured]:
    """Update the decoder and then the algorithm of one seed. Returns only the parts that change; the learner holds much more."""
    sample_key, fit_key = jax.random.split(key)
    credit, measured = learner.credit, {}
    chosen = sample_credit(learner.replay, sample_key, 1, config)
    if chosen is not None:
        credit, measured = common.fit(
            credit, learner.replay, jax.tree.map(lambda leaf: leaf[0], chosen), fit_key, config
        )
    state, settings = learner.algorithm, settings_of(config)
    paid = Paid(credit, learner.scale)
    batch = sequences(learner.replay, episodes, steps, paid, state.states, config)
    played = number * settings.update_every
    moves = played // settings.target_every > (played - settings.update_every) // settings.target_every
    made, learned = qmix.update(state.qmix, batch, moves, settings)
    return (made, credit), measured | learned


def improve(
    learner: Learner, steps: Trajectory, keys: Key[Array, " seeds"], done: Int[Scalar, ""], config: TrainConfig
) -> tuple[Learner, dict[str, Float[Array, " seeds"]]]:
    """One update for every `update_every` episodes that have ended, once there are enough for a batch; the mean of each metric.

    This function is for all seeds, so that the length of a batch is one number for all of them, and no longer than needed.
    """
    settings, before = settings_of(config), learner.algorithm.done
    worth = jnp.sum(learner.replay.episodes, axis=1) // settings.update_every
    ready = jnp.sum(jax.vmap(replay.finished)(learner.replay), axis=1) >= settings.batch_size
    owed = jnp.where(ready, worth - before, 0)
    states = jax.vmap(partial(with_states, config=config))(learner.algorithm.states, steps)
    learner = learner._replace(algorithm=learner.algorithm._replace(states=states, done=worth))
    cuts = lengths(config)

    def update(turn: Int[Scalar, ""], carry: tuple[Updated, Measured]) -> tuple[Updated, Measured]:
        (made, credit), total = carry
        now = learner._replace(algorithm=learner.algorithm._replace(qmix=made), credit=credit)
        sample_keys, update_keys = jnp.unstack(
            jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, turn)))(keys), axis=1
        )
        sample = partial(sample_distinct_episodes, count=settings.batch_size)
        episodes = jax.vmap(sample)(now.replay, sample_keys)
        longest = jnp.max(episodes.length * (episodes.mask > 0))
        branches = [jax.vmap(partial(one_update, config=config, steps=cut)) for cut in cuts]
        place = jnp.searchsorted(jnp.asarray(cuts), longest)
        updated, measured = jax.lax.switch(place, branches, now, episodes, update_keys, before + turn + 1)
        mask = turn < owed

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        sums = {name: total[name] + jnp.where(mask, values, 0) for name, values in measured.items()}
        return jax.tree.map(choose, updated, (made, credit)), sums

    names = ["critic/loss", "critic/value"]
    if config.interleaved:
        names += loss_names(config)
    nothing = {name: jnp.zeros(len(owed)) for name in names}
    (made, credit), total = jax.lax.fori_loop(
        0, jnp.max(owed), update, ((learner.algorithm.qmix, learner.credit), nothing)
    )
    learner = learner._replace(algorithm=learner.algorithm._replace(qmix=made), credit=credit)
    measured = {name: values / owed for name, values in total.items()}  # NaN where there was no update
    return learner, measured | {"algorithm/updates": owed.astype(jnp.float32)}


def loss_names(config: TrainConfig) -> list[str]:
    """The metrics of the decoders' updates."""
    some = [{"credit/loss": jnp.zeros(())} for _ in config.env.teams]
    return list(common.by_team(some, config))


def with_states(states: RunningMeanStd, steps: Trajectory, config: TrainConfig) -> RunningMeanStd:
    """The statistics with the mixer's inputs for new steps."""
    rows = mixer_input({"state": steps.after.state, "observation": steps.after.observation}, config)
    return observe(states, jnp.asarray(rows).reshape(-1, rows.shape[-1]))
