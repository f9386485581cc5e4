"""Linear regression of returns on mean features of episodes, with one prior precision for each group of features.

The reward of a step is linear in its features f, plus noise:

    r_t = b + w . f_t + e_t,      w_i ~ N(0, 1 / alpha_g)  for every i in group g,      e_t ~ N(0, 1 / beta)

Only the sum R_k of an episode's rewards is observed. If episode k has T_k steps with mean features m_k, its mean reward
y_k = R_k / T_k is

    y_k = b + w . m_k + N(0, 1 / (beta T_k))

b has a flat prior, which is integrated out. Everything else is computed from sums over episodes, each weighted by its number of
steps: the weighted means m' and y', and S = sum T (m - m')(m - m')^T, p = sum T (m - m')(y - y'), q = sum T (y - y')^2. The
posterior of w is N(mu, Sigma):

    Sigma^-1 = beta S + diag(alpha),     mu = beta Sigma p,     b = y' - mu . m'

The precisions alpha and beta maximise the evidence, which is the likelihood of the returns. At the maximum, with n_g features in
a group and gamma_g of them determined by the data (MacKay, Neural Computation 4, 1992; Tipping, JMLR 1, 2001):

    gamma_g = n_g - alpha_g tr Sigma_gg,     alpha_g = gamma_g / |mu_g|^2,
    beta = (N - 1 - sum gamma) / (q - 2 mu . p + mu . S mu)

The data switch off a group that does not help: its alpha grows. Efroni et al. (AAAI 2021) show that a regression on sums recovers
rewards.

A score may instead be an average over the steps: R_k = b + w . m_k + N(0, 1 / (beta T_k)). The equations are the same, with y_k = R_k
and the same S. The reward of a step is then (b + w . f) / T.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit.precisions import JITTER, TOLERANCE, AlphaIndex, Backend, Posterior, Regression, n_alphas, varies
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.nn.masks import select
from lare_rl.nn.normalise import RunningMeanStd, merge_means, running_std

__all__ = [
    "JAX_BACKEND",
    "PosteriorCovariance",
    "SufficientStatistics",
    "add_episodes",
    "add_prefixes",
    "empty_statistics",
    "first_true",
    "fit",
    "fixed_point",
    "init_posterior",
    "most_likely",
    "posterior_covariance",
    "posterior_std",
    "regression",
    "split_double",
    "starting_precisions",
    "to_float64",
    "transform",
    "unscale",
]

FIRST_GROUP_GAIN, OTHER_GROUPS_LOSS, LOW_NOISE = 100, 1e4, 1e-6
"""Start 3 of `fit`: the first group may explain `FIRST_GROUP_GAIN` times its equal share, each other group its equal share
divided by `OTHER_GROUPS_LOSS`, and the noise `LOW_NOISE` times the variance of the returns."""


def _sum_by_alpha(values: Float[Array, " features"], alpha_index: AlphaIndex) -> Float[Array, " alphas"]:
    return jnp.zeros(n_alphas(alpha_index)).at[alpha_index].add(values)


JAX_BACKEND = Backend(jnp, _sum_by_alpha, partial(solve_triangular, lower=True))


class SufficientStatistics(NamedTuple):
    """Weighted mean and products of cases: episodes, v_k = (m_k, R_k / T_k, R_k) with weight T_k, or prefixes (`add_prefixes`)."""

    n_episodes: Float[Array, ""]
    n_steps: Float[Array, ""]
    """The sum of the weights."""
    mean: Float[Array, " features_and_targets"]
    products: Float[Array, "features_and_targets features_and_targets"]
    """sum_k T_k (v_k - mean)(v_k - mean)^T"""


def empty_statistics(n_features: int) -> SufficientStatistics:
    """Return the statistics of no episodes."""
    size = n_features + 2
    return SufficientStatistics(jnp.zeros(()), jnp.zeros(()), jnp.zeros(size), jnp.zeros((size, size)))


def split_double(statistics: SufficientStatistics) -> SufficientStatistics:
    """Split each number into two float32 numbers that add up to it, along a new leading axis."""

    def split(number: Array) -> Float[Array, "2 *shape"]:
        # Not number.astype(float32): XLA may leave out a conversion to float32 and back, and the second number would be 0.
        high = jax.lax.reduce_precision(number, exponent_bits=8, mantissa_bits=23)
        return jnp.stack([high, number - high]).astype(jnp.float32)

    return jax.tree.map(split, statistics)


def to_float64(statistics: SufficientStatistics) -> SufficientStatistics:
    """Invert `split_double`, in float64 if that is enabled."""
    return jax.tree.map(lambda number: jnp.sum(number.astype(float), axis=0), statistics)


def transform(
    statistics: SufficientStatistics, matrix: Float[Array, "new features_and_targets"]
) -> SufficientStatistics:
    """Return the sums of the cases A v_k, where A is a matrix."""
    products = matrix @ statistics.products @ matrix.T
    return statistics._replace(mean=matrix @ statistics.mean, products=products)


def add_episodes(
    statistics: SufficientStatistics,
    mean_features: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
) -> SufficientStatistics:
    """Add episodes. Episodes of length 0 are padding."""
    weight = length.astype(statistics.mean.dtype)
    v = jnp.concatenate([mean_features, (returns / jnp.maximum(weight, 1))[:, None], returns[:, None]], axis=1)
    return _add_cases(statistics, v, weight, jnp.sum(length > 0))


def add_prefixes(
    statistics: SufficientStatistics,
    features: Float[Array, "rows features"],
    returns: Float[Array, " rows"],
    mask: Bool[Array, " rows"],
    n_episodes: Int[Array, ""],
) -> SufficientStatistics:
    """Add the prefixes of some episodes, each with the return of its whole episode. Rows where `mask` is false are ignored.

    Each prefix has weight 1. N is still the number of episodes, because the prefixes of an episode have the same noise. R takes the place
    of R/T too, so that it is regressed for every score type.
    """
    weight = mask.astype(statistics.mean.dtype)
    v = jnp.concatenate([features, returns[:, None], returns[:, None]], axis=1)
    return _add_cases(statistics, v, weight, n_episodes)


def _add_cases(
    statistics: SufficientStatistics,
    v: Float[Array, "cases features_and_targets"],
    weight: Float[Array, " cases"],
    n_episodes: Int[Array, ""],
) -> SufficientStatistics:
    """Add cases with their weights. Those of weight 0 are padding, and may be NaN."""
    n_new, is_case = jnp.sum(weight), weight[:, None] > 0
    v = jnp.where(is_case, v, 0)
    mean = weight @ v / jnp.maximum(n_new, 1)
    centred = jnp.where(is_case, v - mean, 0)
    n_steps, merged, between = merge_means(statistics.n_steps, statistics.mean, n_new, mean, lambda d: jnp.outer(d, d))
    return SufficientStatistics(
        n_episodes=statistics.n_episodes + n_episodes,
        n_steps=n_steps,
        mean=merged,
        products=statistics.products + (weight[:, None] * centred).T @ centred + between,
    )


def init_posterior(alpha_index: AlphaIndex) -> Posterior:
    """Return the posterior before the first episode. Its precisions are 0, which means that they have no value yet."""
    zero, zeros = jnp.zeros(()), jnp.zeros(n_alphas(alpha_index))
    return Posterior(
        jnp.zeros(len(alpha_index)), bias=zero, alpha=zeros, beta=zero, n_effective=zeros, log_evidence=zero
    )


def regression(
    statistics: SufficientStatistics, score_type: Int[Array, ""] | int, alpha_index: AlphaIndex
) -> Regression:
    """Return the regression of R/T for a score that is a sum, or of R for a score that is an average."""
    n_features = len(alpha_index)
    assert len(statistics.mean) == n_features + 2
    column = n_features + score_type
    n_steps = jnp.maximum(statistics.n_steps, 1)
    y_mean = statistics.mean[column]
    y_std = running_std(RunningMeanStd(statistics.n_steps, y_mean, statistics.products[column, column]))
    s, p = statistics.products[:n_features, :n_features], statistics.products[:n_features, column]
    is_used = varies(jnp.diagonal(s) / n_steps, statistics.mean[:n_features] ** 2)
    s = jnp.where(jnp.outer(is_used, is_used), s + JITTER * jnp.diag(jnp.diagonal(s)), 0)
    return Regression(
        s=s,
        p=jnp.where(is_used, p, 0) / jnp.where(y_std > 0, y_std, 1),
        q=n_steps,
        dof=statistics.n_episodes - 1,
        y_mean=y_mean,
        y_std=y_std,
        alpha_index=alpha_index,
        equal_alpha=JAX_BACKEND.equal_alpha(jnp.diagonal(s), n_steps, alpha_index),
    )


def fit(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    alpha_index: AlphaIndex,
    start: Posterior,
    max_rounds: int | Int[Array, ""],
    *,
    vectorized: bool = False,
) -> Posterior:
    """Return the posterior under the precisions that maximise the evidence.

    While episodes are few, the evidence may have several maxima: one where all variation is noise, and one where none is. An
    iteration that starts near such a maximum stays there, however many episodes follow. So there are three starts, and the largest
    evidence wins:

    1. `start`;
    2. equal shares, half of the variance noise;
    3. first group alone, almost no noise.

    Without an earlier fit, start 1 has equal shares too, and start 2 has one round. With an earlier fit and
    `Regression.has_many_episodes`, starts 2 and 3 have one round each.

    Args:
        start: an earlier fit, whose precisions start the iteration, or `init_posterior`.
        max_rounds: the maximum number of rounds of each iteration.
        vectorized: whether the three iterations run at once.
    """
    problem = regression(statistics, score_type, alpha_index)
    few = ~problem.has_many_episodes
    limits = jnp.where(jnp.stack([jnp.array(True), start.has_fit & few, ~start.has_fit | few]), max_rounds, 1)
    starts = starting_precisions(problem, start)
    candidates = map_leading_axis(lambda args: fixed_point(problem, *args), (*starts, limits), vectorized=vectorized)
    return unscale(statistics, problem, most_likely(candidates), fallback=start)


def starting_precisions(problem: Regression, start: Posterior) -> tuple[Float[Array, "3 alphas"], Float[Array, "3"]]:
    """Return alpha and beta of the three starts of `fit`."""
    equal = problem.equal_alpha, 2 * problem.dof / problem.q
    earlier = select(start.has_fit, (start.alpha, start.beta), equal)
    first_group = (OTHER_GROUPS_LOSS * problem.equal_alpha).at[0].set(problem.equal_alpha[0] / FIRST_GROUP_GAIN)
    first_alone = first_group, problem.dof / (LOW_NOISE * problem.q)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), earlier, equal, first_alone)


def most_likely(candidates: Posterior) -> Posterior:
    """Return the candidate with the largest evidence. Among candidates within `TOLERANCE` of it, return the first."""
    log_evidence = jnp.nan_to_num(candidates.log_evidence, nan=-jnp.inf)
    best = first_true(log_evidence > jnp.max(log_evidence) - TOLERANCE)
    return jax.tree.map(lambda leaf: leaf[best], candidates)


def first_true(mask: Bool[Array, " values"]) -> Int[Array, ""]:
    """Return the first index where `mask` is true, as int32: the program around this one may be compiled without float64."""
    return jax.lax.argmax(mask, 0, jnp.int32)


def unscale(
    statistics: SufficientStatistics, problem: Regression, posterior: Posterior, fallback: Posterior
) -> Posterior:
    """Return a posterior with its weights in the unit of y, and b = y' - mu . m'.

    With fewer than two episodes, or if all returns are equal, the weights are 0 and the precisions those of `fallback`.
    """
    is_determined = (problem.dof > 0) & (problem.y_std > 0)
    posterior = select(is_determined, posterior, fallback)
    weight = jnp.where(is_determined, problem.y_std * posterior.weight, 0)
    bias = problem.y_mean - weight @ statistics.mean[: len(problem.alpha_index)]
    return posterior._replace(weight=weight, bias=bias)


_State = tuple[Int[Array, ""], Float[Array, ""], Posterior]
"""The number of rounds so far, the evidence before the last of them, and the posterior."""


def fixed_point(
    problem: Regression, alpha: Float[Array, " alphas"], beta: Float[Array, ""], max_rounds: int | Int[Array, ""]
) -> Posterior:
    """Iterate from some precisions until the evidence stops changing, at most `max_rounds` rounds."""

    def is_unsettled(state: _State) -> Bool[Array, ""]:
        n_rounds, previous_evidence, posterior = state
        return (n_rounds < max_rounds) & (jnp.abs(posterior.log_evidence - previous_evidence) > TOLERANCE)

    def body(state: _State) -> _State:
        n_rounds, _, posterior = state
        return n_rounds + 1, posterior.log_evidence, _round(problem, posterior.alpha, posterior.beta)

    posterior = _round(problem, alpha, beta)
    state = jnp.array(1), jnp.full_like(posterior.log_evidence, -jnp.inf), posterior
    return jax.lax.while_loop(is_unsettled, body, state)[2]


def _round(problem: Regression, alpha: Float[Array, " alphas"], beta: Float[Array, ""]) -> Posterior:
    return JAX_BACKEND.next_posterior(problem, alpha, beta, partial(JAX_BACKEND.dense_moments, problem))


class PosteriorCovariance(NamedTuple):
    """The posterior variance of b + w . f is |root (f - centre)|^2 + centre_variance, in squared units of y."""

    root: Float[Array, "features features"]
    """root^T root = Sigma."""
    centre: Float[Array, " features"]
    """m'."""
    centre_variance: Float[Array, ""]
    """The variance of y', the mean reward at the centre."""


def posterior_covariance(
    statistics: SufficientStatistics, score_type: Int[Array, ""] | int, alpha_index: AlphaIndex, posterior: Posterior
) -> PosteriorCovariance:
    """Return the covariance of a posterior. It is 0 as long as all returns are equal.

    The weight of a feature without data has its prior standard deviation.
    """
    problem = regression(statistics, score_type, alpha_index)
    alpha, beta = JAX_BACKEND.clip_precisions(problem, posterior.alpha, posterior.beta)
    root, _ = JAX_BACKEND.inverse_root(beta * problem.s + jnp.diag(alpha[alpha_index]))
    covariance = PosteriorCovariance(
        root=problem.y_std * root,
        centre=statistics.mean[: len(alpha_index)],
        centre_variance=problem.y_std**2 / (beta * jnp.maximum(statistics.n_steps, 1)),
    )
    return jax.tree.map(lambda leaf: jnp.where(problem.y_std > 0, leaf, 0), covariance)


def posterior_std(covariance: PosteriorCovariance, features: Float[Array, "*batch features"]) -> Float[Array, "*batch"]:
    """Return the posterior standard deviation of b + w . f, in the unit of y.

    `features` may lack the last columns, such as the intercepts of levels. Their uncertainty is left out.
    """
    n_features = features.shape[-1]
    distance = (features - covariance.centre[:n_features]) @ covariance.root[:, :n_features].T
    return jnp.sqrt(jnp.sum(distance**2, axis=-1) + covariance.centre_variance)
