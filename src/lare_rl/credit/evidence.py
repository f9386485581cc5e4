"""Linear regression of returns on mean features of episodes, with one prior precision for each group of features.

The reward of a step is linear in its features f, plus noise:

    r_t = b + w . f_t + e_t,      w_i ~ N(0, 1 / alpha_g)  for every i in group g,      e_t ~ N(0, 1 / beta)

Of an episode k of T steps only the sum of the rewards is known. With m_k the mean of its features, its mean reward
y_k = R_k / T is

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

A score may instead be an average over steps, or a grade: R_k = b + w . m_k + N(0, 1 / (beta T_k)). The equations are the same,
with y_k = R_k and the same S. The reward of a step is then (b + w . f) / T.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

RANGE = 1e6
"""A group may explain at most this many times more, or less, of the returns than its equal share. The limit allows a group that
was switched off to be switched on again."""
ROUNDING = 1e-10
"""This fraction of the diagonal of S is added to S. It exceeds the rounding errors of float64. Without it, S could not be
factorised if features are collinear."""
GAIN = 1e-3
"""The iteration to the fixed point ends when a round changes the log evidence by less than this."""
STRONG, OFF, QUIET = 100, 1e4, 1e-6
"""In the third start of a fit, the first group may explain `STRONG` times its equal share, each other one 1/`OFF` of it, and the
noise `QUIET` times the variance of the returns."""
ENOUGH = 2
"""With more episodes than this for each feature, a fit is not made from the beginning again."""
LEAST_NOISE = 1e-10
"""Smallest variance of the noise, relative to that of the returns. Float32 features and returns cannot resolve less."""


class Sums(NamedTuple):
    """Running sums over episodes of v_k = (m_k, R_k / T_k, R_k), weighted by their steps."""

    episodes: Float[Array, ""]
    steps: Float[Array, ""]
    mean: Float[Array, " features_and_targets"]
    products: Float[Array, "features_and_targets features_and_targets"]
    """sum_k T_k (v_k - mean)(v_k - mean)^T"""


class Posterior(NamedTuple):
    """The posterior of the weights, without their covariance, which `covariance` computes from the sums."""

    weight: Float[Array, " features"]
    bias: Float[Array, ""]
    alpha: Float[Array, " groups"]
    """Precision of the weights of each group, in units of the deviation of y."""
    beta: Float[Array, ""]
    """Precision of a step's noise, in the same units."""
    determined: Float[Array, " groups"]
    """gamma: how many features of each group are determined by the data."""
    log_evidence: Float[Array, ""]
    """Up to a constant that does not depend on groups and precisions."""


def no_sums(features: int) -> Sums:
    """The sums over no episodes."""
    size = features + 2
    return Sums(jnp.zeros(()), jnp.zeros(()), jnp.zeros(size), jnp.zeros((size, size)))


def add_episodes(
    sums: Sums,
    means: Float[Array, "episodes features"],
    returns: Float[Array, " episodes"],
    length: Int[Array, " episodes"],
) -> Sums:
    """Add episodes to the sums. Places of length 0 are empty.

    Both sums are combined as in Chan, Golub and LeVeque (1983), which avoids catastrophic cancellation.
    """
    weight = length.astype(sums.mean.dtype)
    v = jnp.concatenate([means, (returns / jnp.maximum(weight, 1))[:, None], returns[:, None]], axis=1)
    steps = jnp.sum(weight)
    mean = weight @ v / jnp.maximum(steps, 1)
    centred = jnp.where(weight[:, None] > 0, v - mean, 0)
    total, gap = sums.steps + steps, mean - sums.mean
    share = steps / jnp.maximum(total, 1)
    between = jnp.outer(gap, gap) * sums.steps * share
    products = sums.products + (weight[:, None] * centred).T @ centred + between
    return Sums(sums.episodes + jnp.sum(length > 0), total, sums.mean + share * gap, products)


def unknown(features: int, groups: int) -> Posterior:
    """The posterior before the first episode. A precision of 0 means that it has no value yet."""
    zero = jnp.zeros(())
    return Posterior(jnp.zeros(features), zero, jnp.zeros(groups), zero, jnp.zeros(groups), zero)


class Problem(NamedTuple):
    """S, p and q, with y in units of its standard deviation, and the number of episodes."""

    s: Float[Array, "features features"]
    p: Float[Array, " features"]
    q: Float[Array, ""]
    free: Float[Array, ""]
    """N - 1, where N is the number of episodes."""
    unit: Float[Array, ""]
    """The standard deviation of y."""
    group: Int[np.ndarray, " features"]
    equal: Float[Array, " groups"]
    """The alpha of each group under which all groups explain equal parts of the returns, and together half of them."""


def problem(sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"]) -> Problem:
    """The regression of R/T (`form` 0) or of R (1)."""
    features = len(group)
    column = features + form
    unit = jnp.sqrt(sums.products[column, column] / jnp.maximum(sums.steps, 1))
    unit = jnp.where(unit > 1e-6 * jnp.abs(sums.mean[column]), unit, 0)  # a constant may vary by this much in float32
    safe = jnp.where(unit > 0, unit, 1)
    s = sums.products[:features, :features]
    s = s + ROUNDING * jnp.diag(jnp.diagonal(s))
    groups = group.max() + 1
    trace = jnp.zeros(groups).at[group].add(jnp.diagonal(s))
    steps = jnp.maximum(sums.steps, 1)
    equal = jnp.where(trace > 0, 2 * groups * trace / steps, 1)
    return Problem(s, sums.products[:features, column] / safe, steps, sums.episodes - 1, unit, group, equal)


def fit(
    sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"], start: Posterior, rounds: int
) -> Posterior:
    """The posterior under the precisions that the iteration to the fixed point gives.

    The evidence may have several maxima while episodes are few: one where all variation is noise, and one where none is. An
    iteration that starts near such a maximum stays there, however many episodes follow. So there are three iterations: from
    `start`; from equal shares of the groups with half of the variation as noise; and from the first group alone with almost no
    noise. The one that reaches the largest evidence is taken. With more than `ENOUGH` episodes for each feature the others have a
    single round.

    Args:
        sums: the sums over episodes.
        form: 0 if the score is a sum over the steps, 1 if it is an average.
        group: the index of each feature's group.
        start: an earlier fit, whose precisions start the iteration; or `unknown`.
        rounds: the maximum number of rounds of each iteration.
    """
    given = problem(sums, form, group)
    known, few = start.beta > 0, given.free < ENOUGH * len(group)
    most = jnp.where(jnp.stack([jnp.array(True), known & few, ~known | few]), rounds, 1)
    of_each = jax.lax.map(lambda one: fixed_point(given, *one), (*starts(given, start), most))
    found = most_likely(of_each)
    return in_return_units(sums, form, given, found, otherwise=start)


def starts(given: Problem, start: Posterior) -> tuple[Float[Array, "3 groups"], Float[Array, "3"]]:
    """The precisions alpha and beta of the three starts of `fit`. The first two are the same without an earlier fit."""
    known = start.beta > 0
    equal = given.equal, 2 * given.free / given.q
    before = tuple(jnp.where(known, old, new) for old, new in zip((start.alpha, start.beta), equal, strict=True))
    alone = (OFF * given.equal).at[0].set(given.equal[0] / STRONG), given.free / (QUIET * given.q)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), before, equal, alone)


def most_likely(of_each: Posterior) -> Posterior:
    """The posterior with the largest evidence, of some that are stacked. Of several that differ by less than `GAIN`, the first."""
    evidence = jnp.nan_to_num(of_each.log_evidence, nan=-jnp.inf)
    best = jnp.argmax(evidence > jnp.max(evidence) - GAIN)  # the first that is true
    return jax.tree.map(lambda leaf: leaf[best], of_each)


def in_return_units(
    sums: Sums, form: Int[Array, ""] | int, given: Problem, found: Posterior, otherwise: Posterior
) -> Posterior:
    """A fixed point with weights in the unit of y, and b = y' - mu . m'. With fewer than two episodes, or if all returns are
    equal, the weights are 0 and the precisions those of `otherwise`.
    """
    enough = (given.free > 0) & (given.unit > 0)
    found = jax.tree.map(lambda new, old: jnp.where(enough, new, old), found, otherwise)
    weight = jnp.where(enough, given.unit * found.weight, 0)
    features = len(given.group)
    bias = sums.mean[features + form] - weight @ sums.mean[:features]
    return found._replace(weight=weight, bias=bias)


def fixed_point(
    given: Problem, alpha: Float[Array, " groups"], beta: Float[Array, ""], rounds: int | Int[Array, ""]
) -> Posterior:
    """The iteration from some precisions on, at most `rounds` rounds. It ends earlier if the evidence stops changing."""

    def unsettled(state: tuple[Int[Array, ""], Float[Array, ""], Posterior]) -> Bool[Array, ""]:
        done, before, known = state
        return (done < rounds) & (jnp.abs(known.log_evidence - before) > GAIN)

    def again(
        state: tuple[Int[Array, ""], Float[Array, ""], Posterior],
    ) -> tuple[Int[Array, ""], Float[Array, ""], Posterior]:
        done, _, known = state
        return done + 1, known.log_evidence, one_round(given, known.alpha, known.beta)

    first = one_round(given, alpha, beta)
    begin = jnp.array(1), jnp.full_like(first.log_evidence, -jnp.inf), first
    return jax.lax.while_loop(unsettled, again, begin)[2]


def within(
    given: Problem, alpha: Float[Array, " groups"], beta: Float[Array, ""]
) -> tuple[Float[Array, " groups"], Float[Array, ""]]:
    """Clip precisions to a range that float32 can represent in calculations."""
    of_all = jnp.maximum(given.free, 1) / given.q  # the precision if everything is noise
    alpha = jnp.clip(alpha, given.equal / RANGE, given.equal * RANGE)
    return alpha, jnp.clip(beta, of_all / 2, of_all / LEAST_NOISE)


def precision(
    given: Problem, alpha: Float[Array, " groups"], beta: Float[Array, ""]
) -> tuple[Float[Array, "features features"], Float[Array, " features"]]:
    """Sigma^-1 as the Cholesky factor of D^-1 Sigma^-1 D^-1, whose diagonal is 1, and the diagonal of D."""
    inverse = beta * given.s + jnp.diag(alpha[given.group])
    scale = jnp.sqrt(jnp.diagonal(inverse))
    return jnp.linalg.cholesky(inverse / jnp.outer(scale, scale)), scale


def one_round(given: Problem, alpha: Float[Array, " groups"], beta: Float[Array, ""]) -> Posterior:
    """The posterior under some precisions, and the precisions that follow from it."""
    alpha, beta = within(given, alpha, beta)
    factor, scale = precision(given, alpha, beta)
    root = solve_triangular(factor, jnp.diag(1 / scale), lower=True)
    weight = beta * ((root @ given.p) @ root)
    left = given.q - 2 * weight @ given.p + weight @ given.s @ weight
    left = jnp.maximum(left, LEAST_NOISE * given.q)
    groups = len(alpha)
    size = jnp.zeros(groups).at[given.group].add(1.0)
    variances = jnp.zeros(groups).at[given.group].add(jnp.sum(root**2, axis=0))  # tr Sigma_gg
    determined = jnp.clip(size - alpha * variances, 0, size)
    squares = jnp.zeros(groups).at[given.group].add(weight**2)
    log_evidence = 0.5 * (
        given.free * jnp.log(beta)
        + size @ jnp.log(alpha)
        - 2 * jnp.sum(jnp.log(jnp.diagonal(factor)) + jnp.log(scale))
        - beta * left
        - alpha @ squares
    )
    free = jnp.maximum(given.free - jnp.sum(determined), 0.5)
    alpha, beta = within(given, determined / jnp.maximum(squares, 1e-30), free / left)
    return Posterior(weight, jnp.zeros(()), alpha, beta, determined, log_evidence)


class Spread(NamedTuple):
    """The uncertainty of b + w . f: its posterior variance is |root (f - centre)|^2 + of_mean, in squared units of y."""

    root: Float[Array, "*forms features features"]
    """root^T root = Sigma."""
    centre: Float[Array, "*forms features"]
    """m'."""
    of_mean: Float[Array, "*forms"]
    """The variance of y', the mean reward at the centre."""


def spread(sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"], known: Posterior) -> Spread:
    """The spread of a posterior. A feature without data has its prior deviation. All is 0 as long as all returns are equal."""
    given = problem(sums, form, group)
    alpha, beta = within(given, known.alpha, known.beta)
    factor, scale = precision(given, alpha, beta)
    root = given.unit * solve_triangular(factor, jnp.diag(1 / scale), lower=True)
    found = Spread(root, sums.mean[: len(group)], given.unit**2 / (beta * jnp.maximum(sums.steps, 1)))
    return jax.tree.map(lambda leaf: jnp.where(given.unit > 0, leaf, 0), found)


def covariance(
    sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"], known: Posterior
) -> Float[Array, "features features"]:
    """Sigma, in squared units of y over those of the features."""
    root = spread(sums, form, group, known).root
    return root.T @ root


def deviation(known: Spread, features: Float[Array, "*batch features"]) -> Float[Array, "*batch"]:
    """The posterior deviation of b + w . f, in the unit of y."""
    away = (features - known.centre) @ known.root.T
    return jnp.sqrt(jnp.sum(away**2, axis=-1) + known.of_mean)
