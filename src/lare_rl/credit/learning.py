"""Learning from whole episodes: their returns are predicted, then added to sums, then fitted in closed form.

If the fit is to prefixes, the return R_k of an episode is regressed on the sums of features up to each of its steps,

    R_k = V_0 + sum_{s <= t} (b + w . f_ks) + noise,      t = 1, ..., T_k

so that the right side is the expected return V_t after t steps, and the reward b + w . f_t of a step is its change V_t - V_(t-1). With
the history of an episode among the inputs, sums of features are counts, extremes and last values up to t.

All decoders predict returns. The sums are only needed for a fit in closed form. Such a fit is the decoder itself, or it determines
the type of the score.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import closed_form, decoder_state, evidence, linear_decoder, logistic
from lare_rl.credit.closed_form import ClosedForm
from lare_rl.credit.decoder_state import CreditBatch, DecoderState
from lare_rl.credit.linear_decoder import LinearDecoder
from lare_rl.credit.methods import Fit
from lare_rl.credit.prequential import RETURN_TOLERANCE, Predictions, add_predictions
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate, compare_score_types, is_better, score_type_errors
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn import normalise
from lare_rl.nn.normalise import RunningMeanStd

__all__ = [
    "MIN_GROWTH",
    "add_to_log_odds",
    "add_to_sums",
    "estimate_score_type",
    "find_score_mismatch",
    "fit_closed_form",
    "is_fitted",
    "mean_features",
    "predict",
    "predict_then_update",
    "predicted_returns",
]

MIN_BINARY_RETURNS = 16
"""With fewer returns, nothing is said about whether they look as if won or lost."""
MIN_GROWTH = 0.02
"""A decoder learns from new episodes when their number reaches this fraction of the number of old ones. Short episodes thus come in
batches."""


def is_fitted(state: DecoderState) -> Bool[Array, ""]:
    """Return whether the decoder has learned anything yet. Its method must have a fit."""
    if state.closed_decoder is not None:
        return state.closed_decoder.n_fitted > 1  # from one episode it only learns the mean reward
    return optax.tree_utils.tree_get(state.optimizer, "count") > 0


def predict_then_update(state: DecoderState, episodes: CreditBatch, spec: CreditSpec) -> DecoderState:
    """Predict the returns of new episodes, and then add the episodes to the sums of a closed-form fit."""
    state = predict(state, episodes, spec)
    return state if state.closed_form is None else state._replace(closed_form=add_to_sums(state.closed_form, episodes))


def predict(state: DecoderState, episodes: CreditBatch, spec: CreditSpec) -> DecoderState:
    """Store the returns of episodes, and the decoder's predictions of them before it is fitted to these episodes.

    There may be at most as many episodes as the window of `state.predictions` has. Episodes with mask 0 are ignored, and before the
    first fit all of them.
    """
    is_new, returns = episodes.mask > 0, episodes.returns
    predicted = predicted_returns(state, episodes, spec)
    predicted = predicted + decoder_state.level_returns(state, episodes.level, episodes.length)
    closed = state.closed_form
    if state.score_type_predictions is not None and closed is not None:
        by_score_type = _predict_by_score_type(closed, episodes)
        score_type_predictions = add_predictions(
            state.score_type_predictions, returns, by_score_type, is_new & (closed.n_fitted > 1), episodes.level
        )
        state = state._replace(score_type_predictions=score_type_predictions)
        predicted = jnp.where(state.is_log_odds, by_score_type[:, -1], predicted)
    is_predicted = is_new & is_fitted(state)
    predictions = add_predictions(state.predictions, returns, predicted[:, None], is_predicted, episodes.level)
    return state._replace(predictions=predictions)


def _predict_by_score_type(closed: ClosedForm, episodes: CreditBatch) -> Float[Array, "episodes score_types"]:
    """Return the returns of episodes as each score type predicts them: as a sum, as an average, and by the log odds."""
    decoder, columns = closed.decoder, _columns(closed.decoder, episodes)
    n_linear = len(closed.posterior.bias)
    weights = jnp.concatenate([decoder.weight, closed.intercept], axis=1)
    linear = jnp.delete(columns, decoder.basis.n_features, axis=1) if decoder.basis.start_value else columns
    predicted = linear @ weights[:n_linear].T + decoder.bias[:n_linear]
    units = jnp.stack([episodes.length, jnp.ones_like(episodes.length)], axis=1)
    predicted = predicted * units[:, :n_linear] + closed.start_value[:n_linear]
    if closed.log_odds is None:
        return predicted
    expected = logistic.predict(closed.log_odds, _episode_sums(closed.decoder, columns, episodes))
    return jnp.concatenate([predicted, expected[:, None]], axis=1)


def _episode_sums(
    decoder: LinearDecoder, columns: Float[Array, "episodes columns"], episodes: CreditBatch
) -> Float[Array, "episodes columns"]:
    """Return the sums of the features of each episode, from their means, and which level it has."""
    index, basis = np.arange(columns.shape[1]), decoder.basis
    is_feature, is_level = index < basis.n_features, index >= basis.first_level_column
    return columns * jnp.where(is_feature, episodes.length[:, None], is_level)  # without 1/T


def predicted_returns(state: DecoderState, episodes: CreditBatch, spec: CreditSpec) -> Float[Array, " episodes"]:
    """Return the sum of each episode's proxy rewards, which are the mean over the agents that are alive."""
    r_hat = decoder_state.decoder_rewards(state, episodes.inputs, spec, episodes.length[episodes.valid_index])
    team_r_hat = decoder_state.agent_mean(r_hat, episodes.alive)
    return jax.ops.segment_sum(team_r_hat, episodes.episode_index, len(episodes.length))


def mean_features(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "episodes features"]:
    """Return the mean of a linear decoder's features over the steps of each episode, and over the agents that are alive."""
    features = _team_features(decoder, episodes)
    total = jax.ops.segment_sum(features.astype(float), episodes.episode_index, len(episodes.length))
    return total / jnp.maximum(episodes.length, 1)[:, None]


def _team_features(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "rows features"]:
    """Return a linear decoder's features of each step: their mean over the agents that are alive."""
    features = decoder.features(episodes.inputs)
    if features.ndim == 2:
        return features
    if episodes.alive is None:
        weights = jnp.full(features.shape[:2], 1 / features.shape[1])
    else:
        features = jnp.where(episodes.alive[..., None], features, 0)
        n_alive = jnp.maximum(episodes.alive.sum(axis=-1, keepdims=True), 1)
        weights = (episodes.alive / n_alive).astype(jnp.float32)
    return jnp.einsum("raf,ra->rf", features, weights)


def _prefix_columns(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "rows columns"]:
    """Return the sum of the features up to each step, the number of these steps, and which level the episode has."""
    features, index = _team_features(decoder, episodes).astype(float), episodes.valid_index
    row = jnp.arange(len(features))
    first = jax.ops.segment_min(row, episodes.episode_index, len(episodes.length))[index]
    first = jnp.clip(first, 0, len(features) - 1)  # an episode without rows has a very large one
    total = jnp.cumsum(features, axis=0)
    before = total - features
    columns = jnp.concatenate([total - before[first], (row - first + 1.0)[:, None]], axis=1)
    return _append_levels(columns, None if episodes.level is None else episodes.level[index], decoder.basis.n_levels)


def _columns(decoder: LinearDecoder, episodes: CreditBatch) -> Float[Array, "episodes columns"]:
    """Return the mean features of each episode, 1/T if a sum may have a start value, and which level it has."""
    columns = mean_features(decoder, episodes)
    if decoder.basis.start_value:
        columns = jnp.concatenate([columns, 1 / jnp.maximum(episodes.length, 1)[:, None]], axis=1)
    return _append_levels(columns, episodes.level, decoder.basis.n_levels)


def _append_levels(
    columns: Float[Array, "rows columns"], level: Int[Array, " rows"] | None, n_levels: int
) -> Float[Array, "rows all_columns"]:
    if level is None or not n_levels:
        return columns
    return jnp.concatenate([columns, jax.nn.one_hot(level, n_levels, dtype=columns.dtype)], axis=1)


def add_to_sums(closed: ClosedForm, episodes: CreditBatch) -> ClosedForm:
    """Add whole episodes to the sums, in float64 if that is enabled. Episodes whose mask is 0 are ignored."""
    statistics = evidence.to_float64(closed.sufficient_statistics)
    returns, mask = episodes.returns, episodes.mask > 0
    if closed.decoder.basis.prefixes:
        columns, is_step = _prefix_columns(closed.decoder, episodes), decoder_state.step_rows(episodes)
        statistics = evidence.add_prefixes(statistics, columns, returns[episodes.valid_index], is_step, jnp.sum(mask))
    else:
        columns = _columns(closed.decoder, episodes)
        statistics = evidence.add_episodes(statistics, columns, returns, jnp.where(mask, episodes.length, 0))
    closed = closed._replace(
        sufficient_statistics=evidence.split_double(statistics),
        before_end=_add_before_end(closed.before_end, episodes),
    )
    return add_to_log_odds(closed, episodes)


def _add_before_end(before_end: RunningMeanStd, episodes: CreditBatch) -> RunningMeanStd:
    """Add all steps of some episodes but the last one of each."""
    n_inputs, index = len(before_end.mean), episodes.episode_index
    is_last = jnp.append(index[1:] != index[:-1], True)
    valid = decoder_state.valid_rows(episodes)
    mask = valid & ~is_last.reshape(-1, *[1] * (valid.ndim - 1))
    return normalise.update_mean_std(before_end, episodes.inputs[..., :n_inputs], mask)


def add_to_log_odds(closed: ClosedForm, episodes: CreditBatch) -> ClosedForm:
    """Add whole episodes to the last ones, which the fit of log odds reads, if there is one. Episodes whose mask is 0 are ignored."""
    if closed.log_odds is None:
        return closed
    sums = _episode_sums(closed.decoder, _columns(closed.decoder, episodes), episodes)
    return closed._replace(log_odds=logistic.add_episodes(closed.log_odds, sums, episodes.returns, episodes.mask > 0))


def fit_closed_form(state: DecoderState, spec: CreditSpec, *, vectorized: bool = False) -> DecoderState:
    """Fit in closed form to all episodes that have been added, and determine the type of the score.

    `vectorized` is as in `evidence.fit`. A state without a closed form is returned unchanged.
    """
    closed, score_types = state.closed_form, spec.score_types
    if closed is None:
        return state
    if spec.method.fit is Fit.SIGNS:
        closed = closed_form.fit_signs(closed)
    else:
        closed = closed_form.fit(closed, score_types, fixed_length=spec.fixed_length, vectorized=vectorized)
    state = state._replace(closed_form=closed)
    if state.score_type_predictions is not None:
        state = _choose_score_type(state, state.score_type_predictions, score_types)
    index = decoder_state.score_type_index(state, len(score_types))
    if not spec.method.uses_gradient:
        return state._replace(network=linear_decoder.select_score_type(closed.decoder, index))
    scale = closed_form.target_scale(closed, is_average=state.is_average, index=index)
    return state._replace(target_scale=jnp.where(closed.start_value[index] != 0, scale, 0).astype(jnp.float32))


def _choose_score_type(
    state: DecoderState, predictions: Predictions, score_types: tuple[ScoreType, ...]
) -> DecoderState:
    """Choose the type that predicts returns best. An average must do so beyond chance."""
    is_log_odds, is_average = jnp.asarray(False), state.is_average
    if score_types[-1] == ScoreType.LOG_ODDS:
        errors = score_type_errors(predictions)
        is_log_odds = errors[-1] < jnp.min(errors[:-1])
    if ScoreType.AVERAGE in score_types:
        is_average = is_better(predictions, ScoreType.AVERAGE, ScoreType.SUM) & ~is_log_odds
    return state._replace(is_average=is_average, is_log_odds=is_log_odds)


def estimate_score_type(state: DecoderState, spec: CreditSpec) -> ScoreTypeEstimate | None:
    """Return the score type that the decoder uses, or None if the settings give it or it makes no difference.

    A sum and an average make no difference as long as all episodes have the same length.
    """
    if state.score_type_predictions is None:
        return None
    errors = np.asarray(score_type_errors(state.score_type_predictions))
    index = int(decoder_state.score_type_index(state, len(errors)))
    if np.allclose(errors[index], np.delete(errors, index), rtol=1e-3):
        return None
    return compare_score_types(state.score_type_predictions, spec.score_types, index)


def find_score_mismatch(state: DecoderState, spec: CreditSpec) -> Literal["looks_binary", "not_binary"] | None:
    """Return how the last returns disagree with the score that is set.

    "looks_binary": they have two values, and the score is not set to be won or lost. "not_binary": the reverse. None if they agree,
    for few or equal returns, and for a method that cannot fit log odds.
    """
    n_returns = min(int(state.predictions.n_episodes), len(state.predictions.returns))
    returns = np.sort(np.asarray(state.predictions.returns)[:n_returns])
    if spec.method.fit is not Fit.EVIDENCE or n_returns < MIN_BINARY_RETURNS or returns[0] == returns[-1]:
        return None
    gaps = np.diff(returns) > RETURN_TOLERANCE * max(abs(returns[0]), abs(returns[-1]))
    has_two_values = int(gaps.sum()) == 1
    if has_two_values == (ScoreType.LOG_ODDS in spec.score_types):
        return None
    return "looks_binary" if has_two_values else "not_binary"
