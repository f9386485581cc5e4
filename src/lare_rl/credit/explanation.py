"""How much of the variation of returns the factors explain, which factors do, and what correlates with the residual.

Everything is computed from the sums of a closed-form fit. S, p and q are those of `evidence.py`. With N episodes, and precision
beta of the noise of a step, a fit explains the share

    R^2 = 1 - (1 / beta) / (q / (N - 1))

of the variation, which is corrected for the degrees of freedom of the fit. A factor's share of the variation is proportional to the
covariance of its features with the prediction, the sum of their mu_i (S mu)_i. The shares of all factors add up to R^2. The share of
a factor is negative if it offsets others: if its effect is low in episodes in which theirs is high. The shares of raw features are
those of a fit on factors and raw features together. The residual of a fit on the factors alone correlates with the episode mean of
raw feature j by

    (p - S mu)_j / sqrt(S_jj (q - 2 mu . p + mu . S mu))

The effect of factor i is g_i(u_i) = w_i . f_i(u_i), the sum of its linear feature and its shapes times their weights. The weights
alone do not say how the reward rises with the factor, because a sine can replace a line. Let C_i be the covariance of the features
f_i over all steps, with the linear feature first. The line that is closest to the effect has this slope, and this share of the
effect's variance:

    e_i . w_i,  e_i = C_i[0] / C_i[0, 0]        (e_i . w_i)^2 C_i[0, 0] / (w_i . C_i w_i)

The slopes of two factors have the posterior covariance e_i . Sigma_ij e_j. If a factor has two values, such as an event that
happens or not, all of its features are the same line. The slope is then known as soon as the returns determine the effect of the
event, though they do not determine the weights.

Pairs can replace lines too. If at most one of two factors is not 0, such as factors of different choices, f_i f_j = 0, and their pair
is exactly linear in them. So the line c_i u_i + c_j u_j that is closest to a pair over all steps, times the pair's weight, is added to
the weights of u_i and u_j. Only the rest of the pair says that the effect of a factor depends on another one.

A start value of the returns is subtracted first: R - c is explained, and (R - c) / T in place of R / T. Terminal inputs explain only
what all others leave (`terminal.py`).
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import closed_form, evidence, relevance, terminal
from lare_rl.credit.basis import Basis
from lare_rl.credit.closed_form import ClosedForm
from lare_rl.credit.decoder_state import CreditBatch, valid_rows
from lare_rl.credit.evidence import SufficientStatistics
from lare_rl.credit.learning import add_to_sums
from lare_rl.credit.precisions import AlphaIndex, Posterior, Regression
from lare_rl.credit.score_type import ScoreType
from lare_rl.envs.interface import AnyArray
from lare_rl.nn.normalise import RunningMeanStd

__all__ = ["NOTICEABLE_SHARE", "Explanation", "ExplanationState", "add_to_explanation", "explain", "init_explanation"]

MAX_EXPLANATION_ROUNDS = 100
"""The maximum number of rounds of the evidence's fixed point. It is large because there is no earlier fit to start from."""
NOTICEABLE_SHARE = 0.05
"""With a smaller share, a raw feature is not named as important, nor a factor's effect as curved. With a larger one, a raw feature is
used."""
MIN_MEAN_STD = 1e-5
"""The means of a standardised factor over episodes vary by more than rounding if their standard deviation exceeds this."""
MIN_SAME = 1 - 2e-6
"""Two factors are the same if the square of the correlation of their means over episodes exceeds this."""
MIN_DETERMINED = 0.05
"""A raw feature is switched off if the returns determine less than this part of one of its weights."""


class ExplanationState(NamedTuple):
    """Sums over episodes, and sums over steps of the functions of factors and of their products."""

    closed_form: ClosedForm
    n_steps: Float[Array, ""]
    total: Float[Array, " features"]
    """Of all functions of factors."""
    products: Float[Array, "factors single single"]
    """Of two features of the same factor: the factor and its shapes."""
    factor_products: Float[Array, "factors features"]
    """Of a factor and any function of factors."""


_NO_FACTORS = np.zeros(0)


class Explanation(NamedTuple):
    """The explanation of one team's returns. Without factors, their fields are empty."""

    n_episodes: Float[AnyArray, ""]
    mean_length: Float[AnyArray, ""]
    explains_mean_reward: Bool[AnyArray, ""]
    """Whether R/T is explained, not R: the score is a sum, and episodes differ in length."""
    total_r2: Float[AnyArray, ""]
    """R^2 of factors and raw features together. NaN if there are too few returns, or if they do not vary."""
    raw_feature_used: Bool[AnyArray, " raw"]
    """Whether the returns depend on a raw feature. All are used unless each has a strength of its own (`relevance.py`)."""
    raw_feature_shares: Float[AnyArray, " raw"]
    """The share of the variation that each raw feature explains, with its shapes and half of its pairs. It is a part of `total_r2`."""
    residual_correlation: Float[AnyArray, " raw"]
    """The correlation of each raw feature with the residual of the fit on factors; 0 for a raw feature that has never varied."""
    factors_r2: Float[AnyArray, ""] = np.zeros(())
    """R^2 of the factors alone, with their shapes and pairs."""
    factor_varies: Bool[AnyArray, " factors"] = _NO_FACTORS > 0
    """Whether the mean of a factor, of its shapes or of its pairs differs between episodes by more than rounding."""
    factor_shares: Float[AnyArray, " factors"] = _NO_FACTORS
    """The share of the variation that each factor explains, with its shapes and half of its pairs. It is negative if the factor offsets
    others. The shares add up to `factors_r2`."""
    pair_shares: Float[AnyArray, " factors"] = _NO_FACTORS
    """The part of `factor_shares` that comes from the factor's pairs with other factors."""
    slope: Float[AnyArray, " factors"] = _NO_FACTORS
    """How much a step's reward rises if a factor rises by one standard deviation: the slope of the line that is closest to its effect
    in the fit on factors; 0 if its mean does not vary. If the score is an average, it is that of a step of an episode of average length."""
    slope_covariance: Float[AnyArray, "factors factors"] = np.zeros((0, 0))
    """The posterior covariance of `slope`."""
    linear_share: Float[AnyArray, " factors"] = _NO_FACTORS
    """The share of the variance of each factor's effect that this line has; 1 for a factor without effect."""
    std: Float[AnyArray, " factors"] = _NO_FACTORS
    """The standard deviation that `slope` is for, in the factor's own unit."""
    terminal: Bool[AnyArray, " factors"] = _NO_FACTORS > 0
    """Whether the factor varies only in the last steps of episodes (`terminal.py`)."""
    same_as: Int[AnyArray, " factors"] = np.zeros(0, int)
    """The index of another factor with the same mean in all episodes, up to scale and offset; -1 if there is none."""


def init_explanation(statistics: RunningMeanStd, basis: Basis) -> ExplanationState:
    """Return empty sums. `statistics` standardise the inputs, and the features of `basis` explain the returns."""
    closed = closed_form.reset_statistics(closed_form.init(basis, (ScoreType.SUM,)), statistics)
    (factors, single), features = _single_features(basis).shape, basis.n_factor_features
    products = jnp.zeros((factors, single, single)), jnp.zeros((factors, features))
    return ExplanationState(closed, jnp.zeros(()), jnp.zeros(features), *products)


def add_to_explanation(state: ExplanationState, episodes: CreditBatch) -> ExplanationState:
    """Add whole episodes to the sums, without their levels. Call this within `float64()`."""
    decoder, valid = state.closed_form.decoder, valid_rows(episodes)
    features = decoder.features(episodes.inputs)[..., : len(state.total)].astype(float)
    features = jnp.where(valid[..., None], features, 0)
    single = features[..., _single_features(decoder.basis)]
    return ExplanationState(
        add_to_sums(state.closed_form, episodes),
        state.n_steps + jnp.sum(valid),
        state.total + jnp.einsum("...i->i", features),
        state.products + jnp.einsum("...fi,...fj->fij", single, single),
        state.factor_products + jnp.einsum("...f,...i->fi", single[..., 0], features),
    )


def explain(
    state: ExplanationState, score_type: Int[Array, ""] | int, start_value: Float[Array, ""] | float = 0.0
) -> Explanation:
    """Explain the returns of the episodes in the sums, less their start value. Call this within `float64()`."""
    statistics, basis = evidence.to_float64(state.closed_form.sufficient_statistics), state.closed_form.decoder.basis
    explains_mean_reward = (score_type == ScoreType.SUM) & _lengths_differ(statistics)
    if basis.start_value:
        statistics, basis = _subtract(statistics, basis.n_features, start_value), replace(basis, start_value=False)
    is_factor = basis.is_factor_feature
    columns = terminal.terminal_columns(basis, statistics, state.closed_form.before_end)
    full = _fit(statistics, score_type, basis.group_index, basis.strength_index, columns)
    raw_single, raw_pairs = _input_shares(full.feature_shares[~is_factor], basis.n_raw_used, basis.raw_frequencies)
    raw_shares = raw_single + raw_pairs
    mean_length = statistics.n_steps / jnp.maximum(statistics.n_episodes, 1)
    explanation = Explanation(
        n_episodes=statistics.n_episodes,
        mean_length=mean_length,
        explains_mean_reward=explains_mean_reward,
        total_r2=full.r2,
        # A share counts pairs too, and the strengths do not know terminal inputs.
        raw_feature_used=_is_used(full, basis) | (raw_shares > NOTICEABLE_SHARE) | columns[_raw_features(basis)],
        raw_feature_shares=raw_shares,
        residual_correlation=jnp.zeros(basis.n_raw_used),
    )
    if not is_factor.any():
        return explanation
    factor_statistics, group_index = _select(statistics, np.flatnonzero(is_factor)), basis.group_index[is_factor]
    lines, columns = _lines_of_pairs(state), columns[: basis.n_factor_features]
    factors = _fit(factor_statistics, score_type, group_index, group_index, columns, lines)
    single, pairs = _input_shares(factors.feature_shares, basis.n_factors, basis.factor_frequencies)
    separate = terminal.separate_columns(factor_statistics, columns)
    root = evidence.posterior_covariance(separate, score_type, group_index, factors.posterior).root
    root = root + root @ lines.T
    slope, slope_covariance, linear_share = _slopes(
        factors.posterior.weight + lines @ factors.posterior.weight, root.T @ root, state
    )
    varies = jnp.diagonal(factors.problem.s) > MIN_MEAN_STD**2 * statistics.n_steps
    divisor = jnp.where(score_type == ScoreType.AVERAGE, mean_length, 1)  # r_hat of an average is divided by T
    return explanation._replace(
        total_r2=jnp.maximum(full.r2, factors.r2),
        factors_r2=factors.r2,
        factor_varies=sum(_input_shares(varies.astype(float), basis.n_factors, basis.factor_frequencies)) > 0,
        factor_shares=single + pairs,
        pair_shares=pairs,
        slope=slope / divisor,
        slope_covariance=slope_covariance / divisor**2,
        linear_share=linear_share,
        std=state.closed_form.decoder.std[: basis.n_factors],
        terminal=columns[: basis.n_factors],
        same_as=_same_as(factors.problem.s[: basis.n_factors, : basis.n_factors]),
        residual_correlation=_residual_correlation(full.problem, basis, factors.posterior),
    )


class _Fit(NamedTuple):
    problem: Regression
    posterior: Posterior
    has_own_strengths: Bool[Array, ""]
    """Whether each raw feature has a strength of its own. The posterior then has a precision for each."""
    r2: Float[Array, ""]
    feature_shares: Float[Array, " features"]
    """The share of the variation that each feature explains. The shares add up to `r2`."""


def _fit(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    group_index: AlphaIndex,
    strength_index: AlphaIndex,
    columns: Bool[Array, " features"],
    lines: Float[Array, "features features"] | float = 0.0,
) -> _Fit:
    """Fit the features, and what they leave to the terminal `columns` among them."""
    problem, indices = evidence.regression(statistics, score_type, group_index), (group_index, strength_index)
    start, earlier = map(evidence.init_posterior, indices)
    not_terminal, rounds = terminal.keep_columns(statistics, ~columns), MAX_EXPLANATION_ROUNDS
    groups, strengths = relevance.fit(not_terminal, score_type, *indices, start, earlier, rounds)
    first = relevance.select(strengths, groups, *indices)
    second = terminal.fit_residual(statistics, score_type, group_index, first.weight, columns, rounds)
    posterior = first._replace(weight=second.weight)
    unexplained = _unexplained(problem, first)
    unexplained = unexplained * jnp.where(jnp.any(columns) & second.has_fit, _unexplained(problem, second), 1)
    r2 = jnp.where((problem.dof > 1) & (problem.y_std > 0), 1 - unexplained, jnp.nan)
    weight = posterior.weight / jnp.where(problem.y_std > 0, problem.y_std, 1)
    covariance = problem.s @ weight
    covariance = (weight + jnp.dot(lines, weight)) * (covariance - jnp.dot(covariance, lines))
    total = jnp.sum(covariance)
    has_own_strengths = relevance.is_better(strengths, groups)
    return _Fit(problem, posterior, has_own_strengths, r2, r2 * covariance / jnp.where(total > 0, total, 1))


def _unexplained(problem: Regression, posterior: Posterior) -> Float[Array, ""]:
    """Return the share of the variation that a fit does not explain, corrected for its degrees of freedom."""
    return jnp.clip(problem.dof / (problem.q * jnp.where(posterior.beta > 0, posterior.beta, 1)), 0, 1)


def _is_used(fit: _Fit, basis: Basis) -> Bool[Array, " raw"]:
    """Return which raw features the returns determine to a part that is larger than `MIN_DETERMINED`."""
    group_index, strength_index = basis.group_index, basis.strength_index
    names, n_raw = list(basis.group_sizes), basis.n_raw_used
    n_effective = jnp.zeros(n_raw)
    for name in ("raw features", "shapes of raw features"):
        if name in names:
            first = int(strength_index[group_index == names.index(name)][0])
            n_effective = n_effective + fit.posterior.n_effective[first : first + n_raw]
    return ~fit.has_own_strengths | (n_effective > MIN_DETERMINED)


def _lengths_differ(statistics: SufficientStatistics) -> Bool[Array, ""]:
    """Return whether R is not the same multiple of R/T in all episodes, which it is if all of them have the same length."""
    length = statistics.n_steps / jnp.maximum(statistics.n_episodes, 1)
    (yy, yr), (_, rr) = statistics.products[-2:, -2:]
    return rr - 2 * length * yr + length**2 * yy > 1e-6 * rr


def _subtract(
    statistics: SufficientStatistics, column: int, start_value: Float[Array, ""] | float
) -> SufficientStatistics:
    """Return the sums with R/T - c/T in place of R/T, and without 1/T, which is this column."""
    matrix = np.delete(np.eye(len(statistics.mean)), column, axis=0)
    return evidence.transform(statistics, jnp.asarray(matrix).at[-2, column].set(-start_value))


def _select(statistics: SufficientStatistics, features: Int[np.ndarray, " selected"]) -> SufficientStatistics:
    """Return the sums of some of the features."""
    n_features = len(statistics.mean) - 2
    columns = np.append(features, [n_features, n_features + 1])  # the last two are R/T and R
    return statistics._replace(mean=statistics.mean[columns], products=statistics.products[np.ix_(columns, columns)])


def _single_features(basis: Basis) -> Int[np.ndarray, "factors single"]:
    """Return the indices of the features of each factor alone, the linear one first."""
    n_single = 1 + 2 * basis.factor_frequencies
    return np.arange(basis.n_factors)[:, None] + basis.n_factors * np.arange(n_single)


def _raw_features(basis: Basis) -> slice:
    """Return the indices of the raw features themselves, without shapes and pairs."""
    return slice(basis.n_factor_features, basis.n_factor_features + basis.n_raw_used)


def _input_shares(
    feature_shares: Float[Array, " features"], n_inputs: int, n_frequencies: int
) -> tuple[Float[Array, " inputs"], Float[Array, " inputs"]]:
    """Return the sums of the shares of each input's own features, and of its pairs.

    A pair gives half to each of its inputs. Either all inputs are paired, or none.
    """
    n_single = 1 + 2 * n_frequencies
    i, j = np.triu_indices(n_inputs if len(feature_shares) > n_single * n_inputs else 0, 1)
    single = jnp.sum(feature_shares[: n_single * n_inputs].reshape(n_single, n_inputs), axis=0)
    half = feature_shares[n_single * n_inputs :] / 2
    return single, jnp.zeros_like(single).at[i].add(half).at[j].add(half)


def _lines_of_pairs(state: ExplanationState) -> Float[Array, "features features"]:
    """Return the matrix that adds, to the weight of each factor, the lines that are closest to its pairs, times their weights."""
    (n_factors, n_features), basis = state.factor_products.shape, state.closed_form.decoder.basis
    pairs = np.stack(np.triu_indices(n_factors if basis.extended else 0, 1), axis=1)
    columns = np.arange(n_features - len(pairs), n_features)
    n_steps = jnp.maximum(state.n_steps, 1)
    mean = state.total / n_steps
    covariance = state.factor_products / n_steps - jnp.outer(mean[:n_factors], mean)
    pair_covariance = covariance[pairs[:, :, None], pairs[:, None, :]]
    line = jnp.linalg.pinv(pair_covariance, rtol=1e-6, hermitian=True) @ covariance[pairs, columns[:, None]][..., None]
    return jnp.zeros((n_features, n_features)).at[pairs, columns[:, None]].set(line[..., 0])


def _slopes(
    weight: Float[Array, " features"], sigma: Float[Array, "features features"], state: ExplanationState
) -> tuple[Float[Array, " factors"], Float[Array, "factors factors"], Float[Array, " factors"]]:
    """Return the slope of each factor's effect, their posterior covariance, and the linear share of each effect's variance."""
    single = _single_features(state.closed_form.decoder.basis)
    n_steps = jnp.maximum(state.n_steps, 1)
    mean = state.total[single] / n_steps
    covariance = state.products / n_steps - mean[:, :, None] * mean[:, None, :]  # C_i
    single_weight, single_sigma = weight[single], sigma[single[:, :, None, None], single]
    variance = covariance[:, 0, 0]
    line = covariance[:, 0] / jnp.where(variance > 0, variance, 1)[:, None]  # e_i
    slope = jnp.sum(line * single_weight, axis=1)
    slope_covariance = jnp.einsum("fi,figj,gj->fg", line, single_sigma, line)
    effect_variance = jnp.einsum("fi,fij,fj->f", single_weight, covariance, single_weight)
    linear_share = slope**2 * variance / jnp.where(effect_variance > 0, effect_variance, 1)
    return slope, slope_covariance, jnp.where(effect_variance > 0, linear_share, 1)


def _same_as(s: Float[Array, "factors factors"]) -> Int[Array, " factors"]:
    """Return `Explanation.same_as`, from the products of the means of factors over episodes."""
    square = s**2 / jnp.maximum(jnp.outer(jnp.diagonal(s), jnp.diagonal(s)), 1e-300)
    square = jnp.where(jnp.eye(len(s)) > 0, 0, square)
    return jnp.where(jnp.max(square, axis=1) > MIN_SAME, jnp.argmax(square, axis=1), -1)


def _residual_correlation(problem: Regression, basis: Basis, posterior: Posterior) -> Float[Array, " raw"]:
    """Return the correlation of the raw features with the residual of a fit on the factors.

    `problem` is the regression on all features, `posterior` that of the fit on the factors.
    """
    n_factor_features = basis.n_factor_features
    weight = posterior.weight / jnp.where(problem.y_std > 0, problem.y_std, 1)
    weight = jnp.zeros(basis.n_features).at[:n_factor_features].set(weight)
    residual_variance = problem.q - 2 * weight @ problem.p + weight @ problem.s @ weight
    raw = _raw_features(basis)
    covariance = (problem.p - problem.s @ weight)[raw]
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(problem.s)[raw] * residual_variance, 0))
    return jnp.where(size > 0, covariance / jnp.where(size > 0, size, 1), 0)
