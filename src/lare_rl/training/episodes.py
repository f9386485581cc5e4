"""How the decoders learn from finished episodes: predict their returns, add them to sufficient statistics, fit.

In this order, the metric `credit/return_r2` is measured on returns before anything is fitted to them.

`learn_returns` is written for all seeds, which read their steps together. Closed forms that are due are fitted together if
`config.vectorized`, else seed by seed. Call it within `float64()`, because `closed_form.py` needs float64.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from lare_rl.algorithms.registry import Consumes
from lare_rl.config.train_config import CreditConfig
from lare_rl.credit import closed_form, learning, logistic
from lare_rl.credit.closed_form import ClosedForm
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.methods import Fit
from lare_rl.credit.spec import CreditSpec
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay
from lare_rl.data.sampling import count_episodes_since, episodes_in_order
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.nn.masks import select
from lare_rl.nn.normalise import RunningMeanStd
from lare_rl.training.decoder_inputs import episode_batch
from lare_rl.training.learner import Learner

__all__ = ["Decoders", "fold_episodes", "learn_returns", "store_predicted_returns"]

MAX_ROWS = 8000
"""The most rows of decoder inputs that are read at a time, unless a single episode has more."""

Decoders = tuple[DecoderState, ...]
State = TypeVar("State")


def learn_returns(learner: Learner, config: CreditConfig) -> Learner:
    """Let decoders learn from finished episodes when there are enough new ones. All arrays have a seed axis.

    With `exact`, except for rollouts, then store new predictions of returns.
    """
    buffer, n_learned = replay.segments_as_episodes(learner.replay), learner.n_learned
    n_before = jnp.sum(n_learned, axis=1)
    n_new = jnp.sum(buffer.current_episode, axis=1) - n_before  # current_episode: episodes ever finished
    has_enough_new = n_new >= jnp.maximum(learning.MIN_GROWTH * n_before, 1)
    learn = partial(_learn_if_due, buffer=buffer, n_learned=n_learned, has_enough_new=has_enough_new, config=config)
    decoders = jax.lax.cond(jnp.any(has_enough_new), learn, lambda unchanged: unchanged, learner.decoders)
    n_now = jnp.where(has_enough_new[:, None], buffer.current_episode, n_learned).astype(n_learned.dtype)
    learned = learner._replace(decoders=decoders, n_learned=n_now)
    if not config.is_exact or config.consumes is Consumes.ROLLOUTS:  # rollouts: predicted with each update
        return learned
    (old, *_), (new, *_) = map(_closed_forms, (learner.decoders, decoders))
    # A new fit changes the proxy rewards of all episodes. After a rebuild, it may count as many episodes as the old one.
    is_new = ((old.n_fitted != new.n_fitted) | (old.n_steps != new.n_steps))[:, None]
    since = jnp.where(is_new, buffer.oldest, jnp.where(has_enough_new[:, None], n_learned, buffer.current_episode))
    return jax.vmap(partial(store_predicted_returns, config=config))(learned, since)


def store_predicted_returns(learner: Learner, since: Int[Array, " envs"], config: CreditConfig) -> Learner:
    """Predict the returns of one seed's episodes anew, from the episode `since` of each environment on, and store them in the replay."""
    buffer = replay.segments_as_episodes(learner.replay)
    slots = buffer.first.shape[-1]

    def body(state: tuple[DecoderState, Array], episodes: CreditBatch, first: Index) -> tuple[DecoderState, Array]:
        decoder, predicted = state
        # A payment belongs to the segment of its last step; with `paid_for`, its first step may lie in an earlier segment.
        last = first.number + episodes.length - 1
        episode = replay.look_up(buffer.episode, first.env, last)
        slot = jnp.where(episodes.mask > 0, episode % slots, slots)  # an index out of range, which is dropped
        values = learning.predicted_returns(decoder, episodes, config.credit_specs[0])
        return decoder, predicted.at[first.env, slot].set(values.astype(predicted.dtype), mode="drop")

    assert buffer.predicted_return is not None
    states = tuple((decoder, buffer.predicted_return[..., i]) for i, decoder in enumerate(learner.decoders))
    states = fold_episodes(states, buffer, since, body, config)
    predicted = jnp.stack([predicted for _, predicted in states], axis=-1)
    return learner._replace(replay=replay.replace_payment_fields(learner.replay, predicted_return=predicted))


def _learn_if_due(
    decoders: Decoders,
    buffer: Replay,
    n_learned: Int[Array, "seeds envs"],
    has_enough_new: Bool[Array, " seeds"],
    config: CreditConfig,
) -> Decoders:
    since = jnp.where(has_enough_new[:, None], n_learned, buffer.current_episode)
    decoders = jax.vmap(partial(_predict_then_update, config=config))(decoders, buffer, since)
    closed = _closed_forms(decoders)
    if not closed:
        return decoders
    if config.method.fit is not Fit.SIGNS:  # signs need no standardised factors
        statistics = tuple(decoder.statistics for decoder in decoders)
        is_stale = has_enough_new & jax.vmap(closed_form.is_stale)(closed[0], statistics[0])
        rebuild = jax.vmap(partial(_rebuild_sums, config=config))
        inputs = closed, statistics, buffer, is_stale
        closed = jax.lax.cond(jnp.any(is_stale), rebuild, lambda unchanged, *_: unchanged, *inputs)
    return tuple(
        _fit_closed_forms(
            decoder._replace(closed_form=form),
            has_enough_new & jax.vmap(closed_form.is_due)(form),
            spec,
            config.vectorized,
        )
        for decoder, form, spec in zip(decoders, closed, config.credit_specs, strict=True)
    )


def _closed_forms(decoders: Decoders) -> tuple[ClosedForm, ...]:
    """Return the fit in closed form of each team; empty if the method has none."""
    return tuple(decoder.closed_form for decoder in decoders if decoder.closed_form is not None)


def fold_episodes(
    states: tuple[State, ...],
    buffer: Replay,
    since: Int[Array, " envs"],
    body: Callable[[State, CreditBatch, Index], State],
    config: CreditConfig,
    expected: int | None = None,
) -> tuple[State, ...]:
    """Apply `body` to each team's state (such as its decoder) and to batches of the finished episodes of one seed.

    Args:
        since: the number of the first episode, in each environment.
        body: the function from a state, a batch of whole episodes, and the first step of each, to the next state.
        expected: about how many episodes there are; None if they may be many.
    """
    buffer = replay.segments_as_episodes(buffer)
    # `learning.predict` stores at most `prediction_window` predictions.
    longest, n_episodes = config.longest_segment, config.credit_specs[0].prediction_window
    expected = n_episodes if expected is None else max(1, expected)
    rows = max(1, min(expected, n_episodes, MAX_ROWS // (config.n_proxy_rewards * longest))) * longest
    total = jnp.sum(count_episodes_since(buffer, since))

    def read_batch(carry: tuple[Int[Array, ""], tuple[State, ...]]) -> tuple[Int[Array, ""], tuple[State, ...]]:
        start, states = carry
        sample = episodes_in_order(buffer, since, start, n_episodes, rows)
        steps = replay.read(buffer, sample.steps)
        first = sample.episodes.first
        states = tuple(body(state, episode_batch(steps, sample, config, i), first) for i, state in enumerate(states))
        n_read = jnp.sum(sample.episodes.mask > 0)
        return start + jnp.maximum(n_read, 1), states  # an episode longer than `longest_segment` is left out

    return jax.lax.while_loop(lambda carry: carry[0] < total, read_batch, (jnp.zeros_like(total), states))[1]


def _predict_then_update(
    decoders: Decoders, buffer: Replay, since: Int[Array, " envs"], config: CreditConfig
) -> Decoders:
    update = partial(learning.predict_then_update, spec=config.credit_specs[0])
    expected = config.iteration_steps // config.longest_segment
    return fold_episodes(decoders, buffer, since, lambda state, batch, _: update(state, batch), config, expected)


def _rebuild_sums(
    closed: tuple[ClosedForm, ...],
    statistics: tuple[RunningMeanStd, ...],
    buffer: Replay,
    is_stale: Bool[Array, ""],
    config: CreditConfig,
) -> tuple[ClosedForm, ...]:
    """Add all stored episodes to new sums if `is_stale` is true, with features standardised by the current statistics."""
    empty = tuple(map(closed_form.reset_statistics, closed, statistics))
    since = jnp.where(is_stale, buffer.oldest, buffer.current_episode)
    without_log_odds = tuple(form._replace(log_odds=None) for form in empty)
    rebuilt = fold_episodes(
        without_log_odds, buffer, since, lambda form, batch, _: learning.add_to_sums(form, batch), config
    )
    if closed[0].log_odds is not None:
        # Episodes are read one environment after the other, and the fit of log odds is to the last ones of all environments.
        n_recent = max(1, logistic.WINDOW // config.n_envs)
        rebuilt = tuple(form._replace(log_odds=old.log_odds) for form, old in zip(rebuilt, empty, strict=True))
        rebuilt = fold_episodes(
            rebuilt,
            buffer,
            jnp.maximum(since, buffer.current_episode - n_recent),
            lambda form, batch, _: learning.add_to_log_odds(form, batch),
            config,
        )
    return select(is_stale, rebuilt, closed)


def _fit_closed_forms(
    decoder: DecoderState, is_due: Bool[Array, " seeds"], spec: CreditSpec, vectorized: bool
) -> DecoderState:
    """Make the closed-form fits of a team's decoder for the seeds that are due."""
    fit = partial(learning.fit_closed_form, spec=spec, vectorized=vectorized)

    def fit_seed(seed: tuple[DecoderState, Bool[Array, ""]]) -> DecoderState:
        decoder, is_due = seed
        return jax.lax.cond(is_due, fit, lambda unchanged: unchanged, decoder)

    return map_leading_axis(fit_seed, (decoder, is_due), vectorized=vectorized)
