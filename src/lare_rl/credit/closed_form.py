"""A decoder that is fitted in closed form to all episodes so far. New episodes only add to its sufficient statistics.

    r_hat = b + w . f(u)        (`linear_decoder.py`)

w and b are computed from sums over episodes (`evidence.py`), without gradient descent. Episode k has T_k steps, the mean
features m_k, the return R_k, and y_k = R_k / T_k, or R_k if the score is an average. In `lare-signs` (the paper's LaRe without
a decoder), w are signs instead:

    w = argmin sum_k T_k (R_k/T_k - w . m_k)^2  over  w in {-1, 1}^d,    b = 0,    f(u) = x

Episodes may belong to levels, which differ in difficulty: maps, weather, demand. A fit then has a random intercept for each level,
whose prior precision is set by the evidence, like that of a group of features:

    y_k = b + c_level(k) + w . m_k + noise,     c ~ N(0, 1 / alpha_levels)

The intercept takes part in the prediction of a return, but no step is paid for it: steps are not paid for the ease of their level.

If episodes differ in length, a sum may have a start value c. An example is a score of 100% minus all losses: c is 100%. No step is
paid for c. In a fit of R/T, it is the weight of 1/T, and the evidence sets its prior precision:

    R_k = c + sum_t (b + w . f_kt) + noise,     R_k / T_k = b + w . m_k + c / T_k + noise,     c ~ N(0, 1 / alpha_start)

If returns are fitted to prefixes of episodes (`learning.py`), b is the weight of the number of steps, and the bias of the fit is V_0.

Inputs that vary only in the last steps of episodes are fitted to the residual of all others (`terminal.py`).

The features depend on the mean and the std that standardise x. If these changed with every step, the sums over earlier steps would
be wrong, so they are kept constant until the number of steps has grown by a half. Then they are updated, and all stored episodes are
summed again.

The sums need float64: if features are nearly collinear, float32 loses all precision. The stored state holds each number as the
sum of two float32 numbers. Call all functions of this module that read or change the sums within
`float64()` (`util/float64.py`).
"""

import itertools
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence, linear_decoder, logistic, relevance, terminal
from lare_rl.credit.basis import Basis
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.linear_decoder import LinearDecoder
from lare_rl.credit.logistic import LogOddsFit
from lare_rl.credit.precisions import Posterior
from lare_rl.credit.score_type import ScoreType
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.nn.normalise import RunningMeanStd, empty_mean_std, running_std

__all__ = [
    "ClosedForm",
    "first_start_value",
    "fit",
    "fit_signs",
    "init",
    "is_due",
    "is_stale",
    "reset_statistics",
    "reward_std",
    "target_scale",
]

MAX_SIGNED_FACTORS = 16
"""The maximum number of factors for which all 2^d combinations of signs are tried."""
STATISTICS_GROWTH = 1.5
"""All episodes are summed again when the number of steps has grown by this factor."""
FIT_GROWTH = 1.05
"""The decoder is fitted again when the number of episodes has grown by this factor."""
MAX_EVIDENCE_ROUNDS = 20
"""The maximum number of rounds of the evidence's fixed point, from each of its starts."""


class ClosedForm(NamedTuple):
    """The state of a fit in closed form."""

    decoder: LinearDecoder
    """The decoder of each score type, along a leading axis."""
    sufficient_statistics: SufficientStatistics
    """Each number is held as two float32 numbers (`evidence.split_double`)."""
    n_steps: Float[Array, ""]
    """The number of rows (one for each agent and step) that mean and std were computed from."""
    before_end: RunningMeanStd
    """Of the inputs, over all steps in the sums but the last step of each episode (`terminal.py`)."""
    n_fitted: Float[Array, ""]
    """The number of episodes that the decoder is fitted to."""
    posterior: Posterior
    """The fit with a precision for each group of features, of each score type but log odds, along a leading axis. The weights of terminal
    inputs are 0."""
    strengths: Posterior
    """The fit with a precision of its own for each raw feature, and for its shapes (`relevance.py`), of the same score
    types. A large precision switches a feature off. The decoder has the weights of the better fit, and other ones for terminal inputs."""
    intercept: Float[Array, "score_types levels"]
    """The intercept of each level, for each score type: part of R/T for a sum that is not fitted to prefixes, else of R."""
    start_value: Float[Array, " score_types"]
    """The part of R that no step is paid for and no level explains, for each score type: V_0 if prefixes are fitted; 0 for a sum without
    the column 1/T, and for an average of episodes of one length."""
    log_odds: LogOddsFit | None
    """The fit of log odds. Only present if the score may be of this type, which is then the last of the decoder's score types."""


def init(basis: Basis, score_types: tuple[int, ...]) -> ClosedForm:
    """Return the state before the first episode."""
    n_score_types, has_log_odds = len(score_types), ScoreType.LOG_ODDS in score_types
    posteriors = tuple(map(evidence.init_posterior, (basis.column_group_index, basis.column_strength_index)))
    posterior, strengths = jax.tree.map(
        lambda leaf: jnp.tile(leaf, (n_score_types - has_log_odds, *[1] * leaf.ndim)), posteriors
    )
    return ClosedForm(
        decoder=linear_decoder.init(basis, n_score_types),
        sufficient_statistics=evidence.split_double(evidence.empty_statistics(basis.n_columns)),
        n_steps=jnp.zeros(()),
        before_end=empty_mean_std(basis.n_standardised),
        n_fitted=jnp.zeros(()),
        posterior=posterior,
        strengths=strengths,
        intercept=jnp.zeros((n_score_types, basis.n_levels)),
        start_value=jnp.zeros(n_score_types),
        log_odds=logistic.init(basis.column_group_index) if has_log_odds else None,
    )


def is_stale(state: ClosedForm, inputs: RunningMeanStd) -> Bool[Array, ""]:
    """Return whether all episodes must be summed again."""
    return inputs.n_rows >= STATISTICS_GROWTH * state.n_steps


def reset_statistics(state: ClosedForm, inputs: RunningMeanStd) -> ClosedForm:
    """Set the sums to zero, and standardise by the mean and std of the inputs of all steps so far.

    Until the next fit, the weights do not match the features.
    """
    return state._replace(
        decoder=eqx.tree_at(lambda d: (d.mean, d.std), state.decoder, (inputs.mean, running_std(inputs))),
        sufficient_statistics=jax.tree.map(jnp.zeros_like, state.sufficient_statistics),
        n_steps=inputs.n_rows,
        before_end=jax.tree.map(jnp.zeros_like, state.before_end),
        n_fitted=jnp.zeros_like(state.n_fitted),
        log_odds=None if state.log_odds is None else logistic.remove_episodes(state.log_odds),
    )


def is_due(state: ClosedForm) -> Bool[Array, ""]:
    """Return whether there are enough new episodes for another fit."""
    return jnp.sum(state.sufficient_statistics.n_episodes) >= jnp.maximum(FIT_GROWTH * state.n_fitted, 1)


class _Weights(NamedTuple):
    """The result of a fit, for some score types."""

    weight: Float[Array, "score_types columns"]
    """Of the features, of the number of steps or 1/T, and of the levels (`Basis.n_columns`)."""
    bias: Float[Array, " score_types"]
    start_value: Float[Array, " score_types"]


def fit(
    state: ClosedForm,
    score_types: tuple[int, ...],
    max_rounds: int = MAX_EVIDENCE_ROUNDS,
    *,
    fixed_length: bool = False,
    vectorized: bool = False,
) -> ClosedForm:
    """Fit the decoder of each score type.

    If `vectorized` is true, the score types sum and average are fitted in one batch, else one after the other. If the score is an
    average and `fixed_length` (all episodes have the same length) is false, no step is paid for the mean return.
    """
    basis = state.decoder.basis
    linear_types = tuple(score_type for score_type in score_types if score_type != ScoreType.LOG_ODDS)
    groups, strengths, best = _fit_linear_types(state, linear_types, max_rounds, vectorized=vectorized)
    weights = _linear_weights(basis, best, _start_value_unit(state))
    if ScoreType.AVERAGE in score_types and not fixed_length:
        weights = _centre_average(state, weights, score_types.index(ScoreType.AVERAGE))
    posterior, strengths = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (groups, strengths))
    state = state._replace(posterior=posterior, strengths=strengths)
    if state.log_odds is not None:
        log_odds = logistic.fit(state.log_odds, basis.column_group_index, ~_terminal_columns(state), max_rounds)
        state = state._replace(log_odds=log_odds)
        start_value, slope = logistic.to_returns(log_odds)
        log_odds_weights = _Weights(slope * log_odds.posterior.weight[None], jnp.zeros(1), start_value[None])
        weights = jax.tree.map(lambda *rows: jnp.concatenate(rows), weights, log_odds_weights)
    return _set_weights(state, weights)


def _fit_linear_types(
    state: ClosedForm, score_types: tuple[int, ...], max_rounds: int, *, vectorized: bool
) -> tuple[Posterior, Posterior, Posterior]:
    """Return the fits of sum and average without terminal inputs, by groups and by strengths, and the better one with them."""
    basis, columns = state.decoder.basis, _terminal_columns(state)
    indices = basis.column_group_index, basis.column_strength_index

    def fit_score_type(args: tuple[Int[Array, ""], Posterior, Posterior]) -> tuple[Posterior, Posterior, Posterior]:
        score_type, *earlier = args
        groups, strengths = jax.tree.map(lambda leaf: leaf.astype(float), earlier)
        statistics = _score_type_statistics(state, score_type)
        first = terminal.keep_columns(statistics, ~columns)
        fits = relevance.fit(first, score_type, *indices, groups, strengths, max_rounds, vectorized=vectorized)
        add_terminal = partial(_add_terminal, statistics, score_type, basis, columns, max_rounds)
        best = jax.lax.cond(jnp.any(columns), add_terminal, lambda unchanged: unchanged, _better_fit(basis, *fits))
        return *fits, best

    rows = jnp.asarray(score_types), state.posterior, state.strengths
    return map_leading_axis(fit_score_type, rows, vectorized=vectorized)


def _terminal_columns(state: ClosedForm) -> Bool[Array, " columns"]:
    statistics = evidence.to_float64(state.sufficient_statistics)
    return terminal.terminal_columns(state.decoder.basis, statistics, state.before_end)


def _better_fit(basis: Basis, groups: Posterior, strengths: Posterior) -> Posterior:
    return relevance.select(strengths, groups, basis.column_group_index, basis.column_strength_index)


def _add_terminal(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""],
    basis: Basis,
    columns: Bool[Array, " columns"],
    max_rounds: int,
    first: Posterior,
) -> Posterior:
    """Return a fit with the weights of terminal inputs, which are 0 before. The start value is fitted again with them.

    A terminal input that is the same in all episodes, such as the fall that ends each of them, has the mean 1/T.
    """
    rounds = jnp.where(jnp.any(columns), max_rounds, 1)  # if `vectorized`, both branches of `cond` run
    if basis.start_value:
        columns = columns.at[basis.n_features].set(True)
    both = terminal.fit_residual(statistics, score_type, basis.column_group_index, first.weight, columns, rounds)
    return first._replace(weight=both.weight, bias=both.bias)


def _score_type_statistics(state: ClosedForm, score_type: Int[Array, ""] | int) -> SufficientStatistics:
    """Return the sums for a fit. Its columns must have about the same size, so 1/T is divided by its mean.

    Unless the score is a sum, 1/T has the weight 0: an average has a constant part already.
    """
    statistics, basis = evidence.to_float64(state.sufficient_statistics), state.decoder.basis
    if not basis.start_value:
        return statistics
    unit = jnp.ones(len(statistics.mean)).at[basis.n_features].set(_start_value_unit(state))
    is_used = (np.arange(basis.n_columns) != basis.n_features) | (score_type == ScoreType.SUM)
    scaled = statistics._replace(mean=statistics.mean * unit, products=statistics.products * jnp.outer(unit, unit))
    return terminal.keep_columns(scaled, is_used)


def _start_value_unit(state: ClosedForm) -> Float[Array, ""]:
    """Return what the column 1/T is multiplied by, the inverse of its mean."""
    mean = evidence.to_float64(state.sufficient_statistics).mean[state.decoder.basis.n_features]
    return 1 / jnp.where(mean > 0, mean, 1)


def first_start_value(state: ClosedForm) -> Float[Array, ""]:
    """Return the start value of a sum by the fit without terminal inputs. Explanations of returns begin with it."""
    basis = state.decoder.basis
    if not basis.start_value:
        return state.start_value[0]
    best = _better_fit(basis, state.posterior, state.strengths)
    first = (_start_value_unit(state) * best.weight[0, basis.n_features]).astype(jnp.float32)
    return jnp.where(jnp.any(_terminal_columns(state)), first, state.start_value[0])


def _linear_weights(basis: Basis, best: Posterior, start_value_unit: Float[Array, ""]) -> _Weights:
    if basis.prefixes:
        return _Weights(best.weight, best.weight[:, basis.n_features], best.bias)
    start_value = jnp.zeros_like(best.bias)
    if basis.start_value:
        start_value = start_value_unit * best.weight[:, basis.n_features]
    return _Weights(best.weight, best.bias, start_value)


def _centre_average(state: ClosedForm, weights: _Weights, index: int) -> _Weights:
    """Move the mean of T r_hat from the rewards of an average to its start value.

    Otherwise T r_hat would be near the mean return at every step. If that is negative, each step costs something, and an agent that can end
    an episode learns to end it, although this does not raise the average.
    """
    n_features, step_mean = state.decoder.basis.n_features, evidence.to_float64(state.sufficient_statistics).mean
    # The intercepts of levels are left out: no step is paid for them.
    mean = weights.bias[index] + weights.weight[index, :n_features] @ step_mean[:n_features]
    bias, start_value = weights.bias.at[index].add(-mean), weights.start_value.at[index].add(mean)
    return weights._replace(bias=bias, start_value=start_value)


def target_scale(state: ClosedForm, *, is_average: Bool[Array, ""], index: Int[Array, ""] | int) -> Float[Array, ""]:
    """Return the root mean square of (R - start value)/T or, of an average, of R - start value.

    Episodes have the weight T. `index` is the position of the score type among all that are fitted.
    """
    statistics, basis = evidence.to_float64(state.sufficient_statistics), state.decoder.basis
    mean, start = statistics.mean, state.start_value[index]
    moments = statistics.products / jnp.maximum(statistics.n_steps, 1) + jnp.outer(mean, mean)
    average_square = moments[-1, -1] - 2 * start * mean[-1] + start**2
    sum_square, column = moments[-2, -2], basis.n_features  # 1/T
    if basis.start_value:
        sum_square = sum_square - 2 * start * moments[column, -2] + start**2 * moments[column, column]
    return jnp.sqrt(jnp.maximum(jnp.where(is_average, average_square, sum_square), 0))


def reward_std(
    state: ClosedForm, rows: Float[Array, "rows inputs"], score_types: tuple[int, ...], index: Int[Array, ""] | int
) -> Float[Array, " rows"]:
    """Return the posterior standard deviation of r_hat, or of T r_hat if the score is an average.

    For terminal inputs it is approximate, because their precisions are taken from the fit without them. Only after `fit`, not after
    `fit_signs`. `index` is the position of the score type among all that are fitted.
    """
    basis, features, n_linear = state.decoder.basis, state.decoder.features(rows), len(state.posterior.bias)
    linear_index = jnp.minimum(index, n_linear - 1)
    best, score_type = _better_fit(basis, state.posterior, state.strengths), jnp.asarray(score_types)[linear_index]
    covariance = evidence.posterior_covariance(
        terminal.separate_columns(_score_type_statistics(state, score_type), _terminal_columns(state)),
        score_type,
        basis.column_strength_index,
        jax.tree.map(lambda leaf: leaf[linear_index].astype(float), best),
    )
    if basis.prefixes:  # a step adds 1 to the number of steps, and V_0 is no part of its reward
        features = jnp.append(features, jnp.ones((*features.shape[:-1], 1)), axis=-1)
        covariance = covariance._replace(centre=jnp.zeros_like(covariance.centre), centre_variance=jnp.zeros(()))
    std = evidence.posterior_std(covariance, features)
    if state.log_odds is None:
        return std
    log_odds_std = evidence.posterior_std(logistic.covariance(state.log_odds), features)
    return jnp.where(index == n_linear, log_odds_std, std)


def fit_signs(state: ClosedForm) -> ClosedForm:
    """Choose the signs for which the signed sum of the factors fits the returns best. Among equally good ones, take the first."""
    statistics, n_factors = evidence.to_float64(state.sufficient_statistics), state.decoder.basis.n_features
    signs = jnp.asarray(np.array(list(itertools.product((1.0, -1.0), repeat=n_factors))))
    # With v = (m, R/T): sum_k T_k (v_k . (w, -1))^2 is the same sum about the mean, plus n_steps * (mean . (w, -1))^2.
    v = jnp.concatenate([signs, -jnp.ones((len(signs), 1))], axis=1)
    error = jnp.sum((v @ statistics.products[:-1, :-1]) * v, axis=1)
    error = error + statistics.n_steps * (v @ statistics.mean[:-1]) ** 2
    best = evidence.first_true(error == jnp.min(error))
    return _set_weights(state, _Weights(signs[best][None], jnp.zeros(1), jnp.zeros(1)))


def _set_weights(state: ClosedForm, weights: _Weights) -> ClosedForm:
    basis, (weight, bias, start_value) = state.decoder.basis, (values.astype(jnp.float32) for values in weights)
    return state._replace(
        decoder=eqx.tree_at(lambda d: (d.weight, d.bias), state.decoder, (weight[:, : basis.n_features], bias)),
        n_fitted=jnp.sum(state.sufficient_statistics.n_episodes),
        intercept=weight[:, basis.first_level_column :],
        start_value=start_value,
    )
