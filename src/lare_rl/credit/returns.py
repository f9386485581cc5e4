"""Learning from whole episodes: their returns are predicted, then added to sums, then fitted in closed form.

All decoders predict returns. The sums are only needed for a fit in closed form. Such a fit is the decoder itself, or it determines
the type of the score.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.closed_form import ClosedForm, LinearDecoder
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import (
    CreditBatch,
    Decomposition,
    agent_mean,
    agent_shares,
    decoder_rewards,
    level_returns,
    score_type_index,
)
from lare_rl.credit.methods import Fit, Method
from lare_rl.credit.prequential import Predictions, add_predictions, squared_errors
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate

__all__ = [
    "MIN_GROWTH",
    "add_episodes",
    "add_to_sums",
    "estimate_score_type",
    "fit_closed_form",
    "is_fitted",
    "is_stale",
    "predict",
    "predict_then_update",
    "predicted_returns",
    "reset_statistics",
    "reward_std",
]

MAX_ERROR_RATIO = 0.95
"""A score is treated as a mean if its predictions as a mean have a squared error below this fraction of the error as a sum. If all
episodes are equally long, both errors are equal except for rounding."""
MIN_GROWTH = 0.02
"""A decoder learns from new episodes when their number exceeds this fraction of the number of old ones. Short episodes thus come in
batches."""
ROUNDING = 1e-6
"""Squared errors below this fraction of the squared returns are treated as equal."""


def is_fitted(state: Decomposition) -> Bool[Array, ""]:
    """Return whether the decoder has learned anything yet."""
    if isinstance(state.network, LinearDecoder):
        assert state.closed_form is not None
        return state.closed_form.n_fitted > 1  # from one episode it only learns the mean reward
    return optax.tree_utils.tree_get(state.optimizer, "count") > 0


def predict_then_update(state: Decomposition, episodes: CreditBatch, settings: CreditSettings) -> Decomposition:
    """Predict the returns of new episodes, and then add the episodes to the sums of a closed-form fit."""
    state = predict(state, episodes, settings)
    return state if state.closed_form is None else add_episodes(state, episodes)


def predict(state: Decomposition, episodes: CreditBatch, settings: CreditSettings) -> Decomposition:
    """Store the returns of episodes, and the decoder's predictions of them before it is fitted to these episodes.

    There may be at most as many episodes as the window of `state.predictions` has. Episodes with mask 0 are ignored, and before the
    first fit all of them.
    """
    is_new, returns = episodes.mask > 0, episodes.mean_reward * episodes.length
    predicted = (predicted_returns(state, episodes, settings) + level_returns(state, episodes.level, episodes.length))[
        :, None
    ]
    predictions = add_predictions(state.predictions, returns, predicted, is_new & is_fitted(state))
    state = state._replace(predictions=predictions)
    if state.score_type_predictions is None or state.closed_form is None:
        return state
    decoder = state.closed_form.decoder
    predicted = _mean_features(decoder, episodes) @ decoder.weight.T + decoder.bias
    if episodes.level is not None:
        predicted = predicted + state.closed_form.intercept[:, episodes.level].T
    predicted = predicted * jnp.stack([episodes.length, jnp.ones_like(episodes.length)], axis=1)
    was_fitted = state.closed_form.n_fitted > 1
    predictions = add_predictions(state.score_type_predictions, returns, predicted, is_new & was_fitted)
    return state._replace(score_type_predictions=predictions)


def predicted_returns(
    state: Decomposition, episodes: CreditBatch, settings: CreditSettings
) -> Float[Array, " episodes"]:
    """Return the sum of each episode's proxy rewards, which are the mean over the agents that are alive."""
    n_episodes = len(episodes.length)
    row_length = episodes.length[jnp.clip(episodes.episode_index, 0, n_episodes - 1)]
    r_hat = agent_mean(decoder_rewards(state, episodes.inputs, settings, row_length), episodes.alive)
    return jax.ops.segment_sum(r_hat, episodes.episode_index, n_episodes)


def _mean_features(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "episodes features"]:
    """Return the mean of a linear decoder's features over the steps of each episode, and over the agents that are alive."""
    features = decoder.features(episodes.inputs)
    if features.ndim == 3:
        n_agents = features.shape[1]
        share = jnp.full(features.shape[:2], 1 / n_agents) if episodes.alive is None else agent_shares(episodes.alive)
        features = jnp.einsum("raf,ra->rf", features, share)
    total = jax.ops.segment_sum(features.astype(float), episodes.episode_index, len(episodes.length))
    return total / jnp.maximum(episodes.length, 1)[:, None]


def _columns(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "episodes columns"]:
    """Return the mean features of each episode, and which level it has."""
    features, n_levels = _mean_features(decoder, episodes), decoder.basis.n_levels
    if not n_levels:
        return features
    assert episodes.level is not None
    one_hot = jax.nn.one_hot(episodes.level, n_levels, dtype=features.dtype)
    return jnp.concatenate([features, one_hot], axis=1)


def is_stale(state: Decomposition) -> Bool[Array, ""]:
    """Return whether the features in the sums were standardised by outdated statistics."""
    assert state.closed_form is not None
    return closed_form.is_stale(state.closed_form, state.statistics)


def reset_statistics(state: Decomposition) -> Decomposition:
    """Set the sums to zero, and standardise features by the newest statistics. All stored episodes must then be added again."""
    assert state.closed_form is not None
    return state._replace(closed_form=closed_form.reset_statistics(state.closed_form, state.statistics))


def add_episodes(state: Decomposition, episodes: CreditBatch) -> Decomposition:
    """Add whole episodes to the sums of a closed-form fit, in float64 if that is enabled."""
    assert state.closed_form is not None
    return state._replace(closed_form=add_to_sums(state.closed_form, episodes))


def add_to_sums(closed: ClosedForm, episodes: CreditBatch) -> ClosedForm:
    """Add whole episodes to the sums, in float64 if that is enabled. Episodes whose mask is 0 are ignored."""
    statistics = evidence.add_episodes(
        closed_form.to_float64(closed.sufficient_statistics),
        _columns(closed.decoder, episodes),
        episodes.mean_reward * episodes.length,
        jnp.where(episodes.mask > 0, episodes.length, 0),
    )
    return closed._replace(sufficient_statistics=closed_form.split_double(statistics))


def fit_closed_form(
    state: Decomposition, method: Method, score_types: tuple[int, ...], *, batched: bool = False
) -> Decomposition:
    """Fit in closed form to all episodes that have been added, and determine the type of the score.

    `batched` is as in `evidence.fit`.
    """
    assert state.closed_form is not None
    if method.fit is Fit.SIGNS:
        closed = closed_form.fit_signs(state.closed_form)
    else:
        closed = closed_form.fit(state.closed_form, score_types, batched=batched)
    state = state._replace(closed_form=closed)
    if state.score_type_predictions is not None:
        sum_error, mean_error = _score_type_errors(state.score_type_predictions)
        state = state._replace(is_mean=mean_error < MAX_ERROR_RATIO * sum_error)
    if not method.uses_gradient:
        index = score_type_index(state, len(score_types))
        state = state._replace(network=closed_form.select_score_type(closed.decoder, index))
    return state


def estimate_score_type(state: Decomposition) -> ScoreTypeEstimate | None:
    """Return the score type that the decoder uses, or None if the settings give it or it makes no difference.

    It makes no difference as long as all episodes have the same length.
    """
    if state.score_type_predictions is None:
        return None
    errors = np.asarray(_score_type_errors(state.score_type_predictions))
    if np.isclose(*errors, rtol=1e-3):
        return None
    score_type = ScoreType(int(state.is_mean))
    is_certain = errors[score_type] < MAX_ERROR_RATIO * errors[1 - score_type]
    return ScoreTypeEstimate(score_type, is_certain=bool(is_certain))


@jax.jit
def _score_type_errors(predictions: Predictions) -> Float[Array, " score_types"]:
    """Return the squared error of each type's predictions, plus a margin for rounding."""
    return squared_errors(predictions) + ROUNDING * jnp.sum(predictions.returns**2)


def reward_std(
    state: Decomposition, rows: Float[Array, "rows inputs"], score_types: tuple[int, ...]
) -> Float[Array, " rows"]:
    """Return the posterior standard deviation of r_hat, or of T r_hat if the score is a mean.

    The method's fit must be `Fit.EVIDENCE`. Call this within `float64()`.
    """
    assert state.closed_form is not None
    assert isinstance(state.network, LinearDecoder)
    index = score_type_index(state, len(score_types))
    spread = evidence.posterior_spread(
        closed_form.to_float64(state.closed_form.sufficient_statistics),
        jnp.asarray(score_types)[index],
        state.network.basis.column_strength_index,
        jax.tree.map(lambda leaf: leaf[index].astype(float), closed_form.best_posterior(state.closed_form)),
    )
    return evidence.posterior_std(spread, state.network.features(rows))
