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

The data switch off a group that does not help (its alpha grows), and switch on a group that is needed. Law et al. (NeurIPS 2018)
regress on sums over groups of cases. Efroni et al. (AAAI 2021) show that such a regression recovers rewards.

A score may instead be a mean over the steps: R_k = b + w . m_k + N(0, 1 / (beta T_k)). The equations are the same, with y_k = R_k
and the same S. The reward of a step is then (b + w . f) / T.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from lare_rl.nn.leading_axis import map_leading_axis

__all__ = [
    "Posterior",
    "PosteriorSpread",
    "SufficientStatistics",
    "add_episodes",
    "empty_statistics",
    "fit",
    "fixed_point",
    "init_posterior",
    "most_likely",
    "posterior_spread",
    "posterior_std",
    "regression",
    "starting_precisions",
    "to_return_units",
]

PRIOR_RANGE = 1e6
"""A group may explain at most this many times more, or less, of the returns than its equal share. Without a limit, a group that was
switched off could not be switched on again."""
JITTER = 1e-10
"""This fraction of the diagonal of S is added to S, so that S can be factorised if features are collinear."""
TOLERANCE = 1e-3
"""The iteration to the fixed point ends when a round changes the log evidence by less than this."""
FIRST_GROUP_GAIN, OTHER_GROUPS_LOSS, LOW_NOISE = 100, 1e4, 1e-6
"""The third start of a fit: the first group may explain `FIRST_GROUP_GAIN` times its equal share, each other group its equal share
divided by `OTHER_GROUPS_LOSS`, and the noise `LOW_NOISE` times the variance of the returns."""
MANY_EPISODES_PER_FEATURE = 2
"""With more episodes than this for each feature, a fit only continues from the earlier one."""
MIN_NOISE = 1e-10
"""The smallest variance of the noise, relative to that of the returns. Float32 features and returns cannot resolve less."""


class SufficientStatistics(NamedTuple):
    """Sums over episodes of v_k = (m_k, R_k / T_k, R_k), weighted by their steps."""

    n_episodes: Float[Array, ""]
    n_steps: Float[Array, ""]
    mean: Float[Array, " features_and_targets"]
    products: Float[Array, "features_and_targets features_and_targets"]
    """sum_k T_k (v_k - mean)(v_k - mean)^T"""


class Posterior(NamedTuple):
    """The posterior of the weights, without their covariance, which `posterior_spread` computes."""

    weight: Float[Array, " features"]
    bias: Float[Array, ""]
    alpha: Float[Array, " groups"]
    """The precision of the weights of each group, in units of the standard deviation of y."""
    beta: Float[Array, ""]
    """The precision of a step's noise, in the same unit."""
    n_determined: Float[Array, " groups"]
    """gamma: how many features of each group the data determine."""
    log_evidence: Float[Array, ""]
    """The log evidence, up to a constant that does not depend on groups and precisions."""


def empty_statistics(n_features: int) -> SufficientStatistics:
    """Return the statistics of no episodes."""
    size = n_features + 2
    return SufficientStatistics(jnp.zeros(()), jnp.zeros(()), jnp.zeros(size), jnp.zeros((size, size)))


def add_episodes(
    statistics: SufficientStatistics,
    mean_features: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
) -> SufficientStatistics:
    """Add episodes. Episodes of length 0 are padding.

    Old and new sums are combined as in Chan, Golub and LeVeque (1983), which avoids catastrophic cancellation.
    """
    weight = length.astype(statistics.mean.dtype)
    v = jnp.concatenate([mean_features, (returns / jnp.maximum(weight, 1))[:, None], returns[:, None]], axis=1)
    n_new = jnp.sum(weight)
    mean = weight @ v / jnp.maximum(n_new, 1)
    centred = jnp.where(weight[:, None] > 0, v - mean, 0)
    n_steps, difference = statistics.n_steps + n_new, mean - statistics.mean
    fraction = n_new / jnp.maximum(n_steps, 1)
    between = jnp.outer(difference, difference) * statistics.n_steps * fraction
    return SufficientStatistics(
        n_episodes=statistics.n_episodes + jnp.sum(length > 0),
        n_steps=n_steps,
        mean=statistics.mean + fraction * difference,
        products=statistics.products + (weight[:, None] * centred).T @ centred + between,
    )


def init_posterior(n_features: int, n_groups: int) -> Posterior:
    """Return the posterior before the first episode. Its precisions are 0, which means that they have no value yet."""
    zero = jnp.zeros(())
    groups = jnp.zeros(n_groups)
    return Posterior(jnp.zeros(n_features), bias=zero, alpha=groups, beta=zero, n_determined=groups, log_evidence=zero)


class Regression(NamedTuple):
    """A regression problem. S, p and q are those of the equations above, with y in units of its standard deviation."""

    s: Float[Array, "features features"]
    p: Float[Array, " features"]
    q: Float[Array, ""]
    dof: Float[Array, ""]
    """N - 1 degrees of freedom, for N episodes."""
    y_mean: Float[Array, ""]
    y_std: Float[Array, ""]
    group_index: Int[np.ndarray, " features"]
    """The index of each feature's group."""
    equal_alpha: Float[Array, " groups"]
    """The alpha of each group by which all groups explain equal parts of the returns, and together half of them."""


def regression(
    statistics: SufficientStatistics, score_type: Int[Array, ""] | int, group_index: Int[np.ndarray, " features"]
) -> Regression:
    """Return the regression of R/T for a score that is a sum, or of R for a score that is a mean."""
    n_features = len(group_index)
    column = n_features + score_type
    n_steps = jnp.maximum(statistics.n_steps, 1)
    y_mean = statistics.mean[column]
    y_std = jnp.sqrt(statistics.products[column, column] / n_steps)
    y_std = jnp.where(y_std > 1e-6 * jnp.abs(y_mean), y_std, 0)  # a constant may vary by this much in float32
    s = statistics.products[:n_features, :n_features]
    s = s + JITTER * jnp.diag(jnp.diagonal(s))
    n_groups = int(group_index.max()) + 1
    trace = _group_sums(jnp.diagonal(s), group_index, n_groups)
    return Regression(
        s=s,
        p=statistics.products[:n_features, column] / jnp.where(y_std > 0, y_std, 1),
        q=n_steps,
        dof=statistics.n_episodes - 1,
        y_mean=y_mean,
        y_std=y_std,
        group_index=group_index,
        equal_alpha=jnp.where(trace > 0, 2 * n_groups * trace / n_steps, 1),
    )


def fit(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    group_index: Int[np.ndarray, " features"],
    start: Posterior,
    max_rounds: int | Int[Array, ""],
    *,
    batched: bool = False,
) -> Posterior:
    """Return the posterior under the precisions that maximise the evidence.

    While episodes are few, the evidence may have several maxima: one where all variation is noise, and one where none is. An
    iteration that starts near such a maximum stays there, however many episodes follow. So there are three iterations: from
    `start`, from equal shares of the groups with half of the variation as noise, and from the first group with almost no noise. The
    largest evidence wins. With `MANY_EPISODES_PER_FEATURE`, the second and the third iteration have a single round.

    Args:
        statistics: the sums over episodes.
        score_type: a `ScoreType`.
        group_index: the index of each feature's group.
        start: an earlier fit, whose precisions start the iteration, or `init_posterior`.
        max_rounds: the maximum number of rounds of each iteration.
        batched: whether the three iterations run at once.
    """
    problem = regression(statistics, score_type, group_index)
    has_start, few = start.beta > 0, problem.dof < MANY_EPISODES_PER_FEATURE * len(group_index)
    limits = jnp.where(jnp.stack([jnp.array(True), has_start & few, ~has_start | few]), max_rounds, 1)
    starts = starting_precisions(problem, start)
    candidates = map_leading_axis(lambda args: fixed_point(problem, *args), (*starts, limits), batched=batched)
    return to_return_units(statistics, problem, most_likely(candidates), fallback=start)


def starting_precisions(problem: Regression, start: Posterior) -> tuple[Float[Array, "3 groups"], Float[Array, "3"]]:
    """Return alpha and beta of the three starts of `fit`. The first two are the same without an earlier fit."""
    has_start = start.beta > 0
    equal = problem.equal_alpha, 2 * problem.dof / problem.q
    earlier = jax.tree.map(lambda old, new: jnp.where(has_start, old, new), (start.alpha, start.beta), equal)
    first_group = (OTHER_GROUPS_LOSS * problem.equal_alpha).at[0].set(problem.equal_alpha[0] / FIRST_GROUP_GAIN)
    first_alone = first_group, problem.dof / (LOW_NOISE * problem.q)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), earlier, equal, first_alone)


def most_likely(candidates: Posterior) -> Posterior:
    """Return the candidate with the largest evidence. Among candidates within `TOLERANCE` of it, return the first."""
    log_evidence = jnp.nan_to_num(candidates.log_evidence, nan=-jnp.inf)
    # The first index where it is true, as int32: the program around this one may be compiled without float64.
    best = jax.lax.argmax(log_evidence > jnp.max(log_evidence) - TOLERANCE, 0, jnp.int32)
    return jax.tree.map(lambda leaf: leaf[best], candidates)


def to_return_units(
    statistics: SufficientStatistics, problem: Regression, posterior: Posterior, fallback: Posterior
) -> Posterior:
    """Return a posterior with its weights in the unit of y, and b = y' - mu . m'.

    With fewer than two episodes, or if all returns are equal, the weights are 0 and the precisions those of `fallback`.
    """
    is_determined = (problem.dof > 0) & (problem.y_std > 0)
    posterior = jax.tree.map(lambda new, old: jnp.where(is_determined, new, old), posterior, fallback)
    weight = jnp.where(is_determined, problem.y_std * posterior.weight, 0)
    bias = problem.y_mean - weight @ statistics.mean[: len(problem.group_index)]
    return posterior._replace(weight=weight, bias=bias)


_State = tuple[Int[Array, ""], Float[Array, ""], Posterior]
"""The number of rounds so far, the evidence before the last of them, and the posterior."""


def fixed_point(
    problem: Regression, alpha: Float[Array, " groups"], beta: Float[Array, ""], max_rounds: int | Int[Array, ""]
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


def _clip_precisions(
    problem: Regression, alpha: Float[Array, " groups"], beta: Float[Array, ""]
) -> tuple[Float[Array, " groups"], Float[Array, ""]]:
    """Clip precisions to a range that float32 can represent."""
    noise_only = jnp.maximum(problem.dof, 1) / problem.q  # beta if all variation is noise
    alpha = jnp.clip(alpha, problem.equal_alpha / PRIOR_RANGE, problem.equal_alpha * PRIOR_RANGE)
    return alpha, jnp.clip(beta, noise_only / 2, noise_only / MIN_NOISE)


def _inverse_root(
    problem: Regression, alpha: Float[Array, " groups"], beta: Float[Array, ""]
) -> tuple[Float[Array, "features features"], Float[Array, ""]]:
    """Return L with L^T L = Sigma, and log det Sigma^-1."""
    precision = beta * problem.s + jnp.diag(alpha[problem.group_index])
    scale = jnp.sqrt(jnp.diagonal(precision))  # a diagonal of ones makes the factorisation accurate
    factor = jnp.linalg.cholesky(precision / jnp.outer(scale, scale))
    root = solve_triangular(factor, jnp.diag(1 / scale), lower=True)
    return root, 2 * jnp.sum(jnp.log(jnp.diagonal(factor)) + jnp.log(scale))


def _round(problem: Regression, alpha: Float[Array, " groups"], beta: Float[Array, ""]) -> Posterior:
    """Compute the posterior under some precisions, and the precisions that follow from it."""
    alpha, beta = _clip_precisions(problem, alpha, beta)
    root, log_det = _inverse_root(problem, alpha, beta)
    weight = beta * ((root @ problem.p) @ root)
    residual = problem.q - 2 * weight @ problem.p + weight @ problem.s @ weight
    residual = jnp.maximum(residual, MIN_NOISE * problem.q)
    n_groups = len(alpha)
    size = _group_sums(jnp.ones_like(weight), problem.group_index, n_groups)
    variance = _group_sums(jnp.sum(root**2, axis=0), problem.group_index, n_groups)  # tr Sigma_gg
    n_determined = jnp.clip(size - alpha * variance, 0, size)
    squares = _group_sums(weight**2, problem.group_index, n_groups)  # |mu_g|^2
    log_evidence = 0.5 * (
        problem.dof * jnp.log(beta) + size @ jnp.log(alpha) - log_det - beta * residual - alpha @ squares
    )
    noise_dof = jnp.maximum(problem.dof - jnp.sum(n_determined), 0.5)
    alpha, beta = _clip_precisions(problem, n_determined / jnp.maximum(squares, 1e-30), noise_dof / residual)
    return Posterior(
        weight=weight,
        bias=jnp.zeros(()),
        alpha=alpha,
        beta=beta,
        n_determined=n_determined,
        log_evidence=log_evidence,
    )


def _group_sums(
    values: Float[Array, " features"], group_index: Int[np.ndarray, " features"], n_groups: int
) -> Float[Array, " groups"]:
    return jnp.zeros(n_groups).at[group_index].add(values)


class PosteriorSpread(NamedTuple):
    """The uncertainty of b + w . f. Its posterior variance is |root (f - centre)|^2 + centre_variance, in squared units of y."""

    root: Float[Array, "*score_types features features"]
    """root^T root = Sigma."""
    centre: Float[Array, "*score_types features"]
    """m'."""
    centre_variance: Float[Array, "*score_types"]
    """The variance of y', the mean reward at the centre."""


def posterior_spread(
    statistics: SufficientStatistics,
    score_type: Int[Array, ""] | int,
    group_index: Int[np.ndarray, " features"],
    posterior: Posterior,
) -> PosteriorSpread:
    """Return the spread of a posterior. It is 0 as long as all returns are equal.

    The weight of a feature without data has its prior standard deviation.
    """
    problem = regression(statistics, score_type, group_index)
    alpha, beta = _clip_precisions(problem, posterior.alpha, posterior.beta)
    root, _ = _inverse_root(problem, alpha, beta)
    spread = PosteriorSpread(
        root=problem.y_std * root,
        centre=statistics.mean[: len(group_index)],
        centre_variance=problem.y_std**2 / (beta * jnp.maximum(statistics.n_steps, 1)),
    )
    return jax.tree.map(lambda leaf: jnp.where(problem.y_std > 0, leaf, 0), spread)


def posterior_std(spread: PosteriorSpread, features: Float[Array, "*batch features"]) -> Float[Array, "*batch"]:
    """Return the posterior standard deviation of b + w . f, in the unit of y. Weights beyond those of the features are ignored."""
    n_features = features.shape[-1]
    distance = (features - spread.centre[..., :n_features]) @ spread.root[..., :n_features].T
    return jnp.sqrt(jnp.sum(distance**2, axis=-1) + spread.centre_variance)
