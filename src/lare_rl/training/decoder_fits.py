"""Gradient updates of the decoders: which steps an update reads, the update, and the first fit for many agents.

The first fit lasts until the error on held-out episodes stops falling. With `first_fit = "published"` there is none: from the first
iteration on, the decoders of IPPO get `fit_updates` updates (50) every `fit_every` iterations (10). With 15 agents that is too few: the
policy has settled before the decoder is accurate (benchmarks/results/agents.md).
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from lare_rl.algorithms.batches import Metrics
from lare_rl.config.train_config import CreditConfig, TrainConfig
from lare_rl.credit import descent, learning
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.prequential import empty_predictions, squared_errors
from lare_rl.credit.spec import CreditSpec
from lare_rl.data import replay
from lare_rl.data.replay import Replay
from lare_rl.data.sampling import CreditSample, sample_episode_steps, sample_packed, sample_padded
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.nn.masks import select
from lare_rl.nn.normalise import root_mean_square
from lare_rl.training.decoder_inputs import episode_batch
from lare_rl.training.episodes import Decoders, fold_episodes
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import team_metrics
from lare_rl.training.seed_axis import jit_over_seeds
from lare_rl.util.rounding import ceil_div

__all__ = [
    "FirstFitStoppedError",
    "config_of_first_fit",
    "fit_until_converged",
    "has_enough_episodes",
    "sample_credit",
    "update_all_seeds",
    "update_decoders",
    "update_repeatedly",
]

CHUNK_ROWS = 2400
"""The most rows of a chunk of a decoder's gradient. More do not fit into the cache of a core; fewer make matrix products inefficient."""

MIN_FIRST_EPISODES = 10
"""With fewer finished episodes of a seed, the first fit waits, and decoders are fitted as published."""
PATIENCE = 2
"""A seed's first fit ends after this many rounds in a row without improvement."""
MAX_ROUNDS = 40
"""The most rounds of a first fit."""
BATCH_DIVISOR = 8
"""An update of the first fit reads fewer steps than a later one: their number divided by this, but at least those of one episode. There are
few episodes yet, and large updates would read each of them several times. The decoder becomes as accurate in an eighth of the time
(benchmarks/first_fit.py)."""


class FirstFitStoppedError(Exception):
    """The user asked the run to stop during the first fit. The iteration in which it ran is lost."""


def sample_credit(buffer: Replay, key: PRNGKeyArray, updates: int, config: CreditConfig) -> CreditSample:
    """Sample the steps that decoders read in each of several updates, on a leading axis of updates."""
    buffer, longest = replay.segments_as_episodes(buffer), config.longest_segment
    plan = descent.plan_batch(config.credit_specs[0], longest)
    match plan.layout:
        case "sampled":
            return sample_episode_steps(buffer, key, updates, plan.episodes, plan.rows)
        case "padded":
            return sample_padded(buffer, key, updates, plan.episodes, plan.rows)
        case "packed":
            # Here every step may be an episode of its own, so `plan.episodes`, which is for `CreditAssigner`, may be too small.
            return sample_packed(buffer, key, updates, config.credit.batch_steps, plan.rows)


def update_decoders(
    decoders: Decoders, buffer: Replay, sample: CreditSample, key: PRNGKeyArray, config: CreditConfig
) -> tuple[Decoders, Metrics]:
    """Update every team's decoder once."""
    steps = replay.read(buffer, sample.steps)
    keys = jax.random.split(key, len(decoders))
    updates = [
        _update_decoder(decoder, episode_batch(steps, sample, config, i), keys[i], config, config.credit_specs[i])
        for i, decoder in enumerate(decoders)
    ]
    return tuple(decoder for decoder, _ in updates), team_metrics([metrics for _, metrics in updates], config.env.teams)


def _update_decoder(
    decoder: DecoderState, batch: CreditBatch, key: PRNGKeyArray, config: CreditConfig, spec: CreditSpec
) -> tuple[DecoderState, Metrics]:
    """Take one gradient step. The gradient of a large batch of equally long episodes is computed in chunks."""
    # Rows of agents count one by one.
    n_rows, n_episodes = batch.inputs[..., 0].size, len(batch.length)
    n_chunks = 1
    if not config.vectorized and config.has_fixed_segments and n_rows > CHUNK_ROWS:
        chunk_episodes = max(1, CHUNK_ROWS * n_episodes // n_rows)
        chunk_counts = range(ceil_div(n_episodes, chunk_episodes), n_episodes + 1)
        n_chunks = next(n for n in chunk_counts if n_episodes % n == 0)
    if n_chunks == 1:
        return descent.update(decoder, batch, key, spec)
    # Every chunk counts its episodes from 0.
    batch = batch._replace(episode_index=batch.episode_index % (n_episodes // n_chunks))
    chunks = jax.tree.map(lambda leaf: leaf.reshape(n_chunks, -1, *leaf.shape[1:]), batch)
    return descent.update_in_chunks(decoder, chunks, key, spec)


def update_all_seeds(learner: Learner, keys: Key[Array, " seeds"], config: CreditConfig) -> tuple[Learner, Metrics]:
    """Update the decoders of every seed `fit_updates` times. Return the mean of each metric."""
    # On a CPU, one seed after the other: a batch of one seed fills the caches already.
    decoders, metrics = map_leading_axis(
        lambda pair: update_repeatedly(*pair, config), (learner, keys), vectorized=config.vectorized
    )
    return learner._replace(decoders=decoders), metrics


def update_repeatedly(learner: Learner, key: PRNGKeyArray, config: CreditConfig) -> tuple[Decoders, Metrics]:
    """Update the decoders `fit_updates` times. Return them, and the mean of each metric."""
    sample_key, key = jax.random.split(key)
    samples = sample_credit(learner.replay, sample_key, config.fit_updates, config)

    def body(decoders: Decoders, update: tuple[CreditSample, PRNGKeyArray]):
        return update_decoders(decoders, learner.replay, *update, config)

    decoders, metrics = jax.lax.scan(body, learner.decoders, (samples, jax.random.split(key, config.fit_updates)))
    return decoders, jax.tree.map(jnp.mean, metrics)


def has_enough_episodes(learner: Learner) -> bool:
    """Return whether every seed has enough episodes for the first fit."""
    n_episodes = jax.vmap(replay.n_stored_episodes)(replay.segments_as_episodes(learner.replay))
    return int(jnp.min(jnp.sum(n_episodes, axis=1))) >= MIN_FIRST_EPISODES


def config_of_first_fit(config: TrainConfig) -> TrainConfig:
    """Return the configuration of the first fit, whose updates read fewer steps, but at least those of an episode."""
    steps = max(config.credit.batch_steps // BATCH_DIVISOR, min(config.longest_segment, config.credit.batch_steps))
    return dataclasses.replace(config, credit=config.credit.model_copy(update={"batch_steps": steps}))


def fit_until_converged(
    learner: Learner,
    fit_round: Callable[[Learner, Key[Array, " seeds"]], tuple[Learner, Metrics]],
    keys: Key[Array, " seeds"],
    config: TrainConfig,
    stop_requested: Callable[[], bool],
) -> tuple[Learner, Metrics]:
    """Fit the decoders repeatedly. Keep, for each seed, the decoders with the least error on held-out episodes, and their metrics.

    Args:
        learner: the learner of all seeds, with enough episodes.
        fit_round: one round of updates. It reuses the memory of its learner.
        keys: random keys; the keys of each round are derived from them.
        stop_requested: whether the user has asked the run to stop.

    Raises:
        FirstFitStoppedError: the user has asked the run to stop.
    """
    # What is needed after a round is copied before it, here and below.
    originals = {
        name: jax.tree.map(jnp.copy, getattr(learner.replay, name)) for name in replay.FIELDS_CHANGED_BY_HIDING
    }
    n_held_out = jax.vmap(partial(_count_held_out, window=config.credit_specs[0].prediction_window))(
        replay.segments_as_episodes(learner.replay)
    )
    compute_error = jit_over_seeds(jax.vmap(partial(_held_out_error, config=config)), config.n_devices)
    best_decoders, best_error = jax.tree.map(jnp.copy, learner.decoders), np.full(len(keys), np.inf)
    rounds_without_gain = np.zeros(len(keys), int)
    metrics: Metrics = {}
    for number in range(MAX_ROUNDS):
        if stop_requested():
            raise FirstFitStoppedError
        round_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)
        hidden = replay.hide_newest(learner.replay, n_held_out)
        learner, new_metrics = fit_round(learner._replace(replay=hidden), round_keys)
        full = learner.replay._replace(**jax.tree.map(jnp.copy, originals))
        learner = learner._replace(replay=full)
        error = np.asarray(compute_error(learner.decoders, full, n_held_out))
        # How long a seed is fitted does not depend on the other seeds.
        is_better = (error < best_error) & (rounds_without_gain < PATIENCE)
        best_decoders = select(jnp.asarray(is_better), learner.decoders, best_decoders)
        metrics = select(jnp.asarray(is_better), new_metrics, metrics) if number else new_metrics
        best_error = np.where(is_better, error, best_error)
        rounds_without_gain = np.where(is_better, 0, rounds_without_gain + 1)
        if (rounds_without_gain >= PATIENCE).all():
            break
    return learner._replace(decoders=best_decoders), metrics


def _count_held_out(buffer: Replay, window: int) -> Int[Array, " envs"]:
    """Return how many of each environment's newest episodes are held out.

    A fifth of the episodes of all environments together is held out, but at most `window`, as many as `Predictions` holds. They are taken
    from the last environment first, then from the one before it.
    """
    available = replay.n_stored_episodes(buffer)
    count = jnp.minimum(jnp.sum(available) // 5, window)
    in_later_envs = jnp.cumsum(available[::-1])[::-1] - available
    return jnp.clip(count - in_later_envs, 0, available)


def _held_out_error(
    decoders: Decoders, buffer: Replay, n_held_out: Int[Array, " envs"], config: CreditConfig
) -> Float[Array, ""]:
    """Return the sum over the teams of the squared error of held-out returns, divided by the mean square of the team's returns."""
    spec = config.credit_specs[0]  # predictions need only what all teams have in common
    decoders = tuple(decoder._replace(predictions=empty_predictions(1, spec.prediction_window)) for decoder in decoders)
    since = replay.segments_as_episodes(buffer).current_episode - n_held_out
    decoders = fold_episodes(
        decoders, buffer, since, lambda decoder, episodes, _: learning.predict(decoder, episodes, spec), config
    )
    errors = [
        squared_errors(decoder.predictions)[0] / root_mean_square(decoder.return_scale) ** 2 for decoder in decoders
    ]
    return sum(errors, start=jnp.zeros(()))
