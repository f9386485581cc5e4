"""Linear regression of returns on what episodes were like, with the strength of every group of features set by the evidence.

A step pays something linear in its features f, and something that nothing tells:

    r_t = b + w . f_t + e_t,      w_i ~ N(0, 1 / alpha_g)  for every i in group g,      e_t ~ N(0, 1 / beta)

Of an episode k of T steps only the sum is known. With m_k the mean of its features, its mean reward y_k = R_k / T is

    y_k = b + w . m_k + N(0, 1 / (beta T_k))

With the flat prior of b integrated out, everything follows from sums over episodes, each weighted by its steps, about their
weighted means: S = sum T (m - m')(m - m')^T, p = sum T (m - m')(y - y'), q = sum T (y - y')^2. The posterior of w is
N(mu, Sigma):

    Sigma^-1 = beta S + diag(alpha),     mu = beta Sigma p,     b = y' - mu . m'

The precisions are those under which the returns are most likely. At the maximum of the evidence, with n_g features in a
group and gamma_g of them determined by the data (MacKay, Neural Computation 4, 1992; Tipping, JMLR 1, 2001):

    gamma_g = n_g - alpha_g tr Sigma_gg,     alpha_g = gamma_g / |mu_g|^2,
    beta = (N - 1 - sum gamma) / (q - 2 mu . p + mu . S mu)

A group that does not help is switched off by the data (alpha grows), one that is needed is switched on. That regression can be
on sums over groups of cases is the setting of Law et al. (NeurIPS 2018); that it recovers rewards, of Efroni et al. (AAAI 2021).

A score may instead be an average over steps or a mark, R_k = b + w . m_k + N(0, 1 / (beta T_k)): the same with y_k = R_k, on
the same S. A step then pays (b + w . f) / T.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

RANGE = 1e6
"""A group may explain so many times more, or less, of the returns than its equal share. Beyond, it is off; but not so far off
that it could not come back."""
ROUNDING = 1e-10
"""So much of the diagonal of S is added to it: more than float64 has lost there. Where features repeat each other, S alone could
not be factorised."""
GAIN = 1e-3
"""In the log evidence: a round of the fixed point that changes it by less is the last one."""
LEAST_NOISE = 1e-10
"""Of the returns' variance. Features and returns in float32 tell no smaller one."""


class Sums(NamedTuple):
    """Running sums over episodes of v_k = (m_k, R_k / T_k, R_k), weighted by their steps."""

    episodes: Float[Array, ""]
    steps: Float[Array, ""]
    mean: Float[Array, " features_and_targets"]
    products: Float[Array, "features_and_targets features_and_targets"]
    """sum_k T_k (v_k - mean)(v_k - mean)^T"""


class Posterior(NamedTuple):
    """What is known of the weights, but for their covariance, which `covariance` makes from the sums."""

    weight: Float[Array, " features"]
    bias: Float[Array, ""]
    alpha: Float[Array, " groups"]
    """Precision of the weights of each group, in units of the deviation of y."""
    beta: Float[Array, ""]
    """Precision of a step's noise, in the same units."""
    determined: Float[Array, " groups"]
    """gamma."""
    log_evidence: Float[Array, ""]
    """Up to a constant that groups and precisions do not change."""


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
    """With more episodes. Places of length 0 hold none.

    Sums over parts are joined after Chan, Golub and LeVeque (1983): no catastrophic cancellation.
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
    """Before there was an episode: no precision has a value yet."""
    zero = jnp.zeros(())
    return Posterior(jnp.zeros(features), zero, jnp.zeros(groups), zero, jnp.zeros(groups), zero)


class Problem(NamedTuple):
    """S, p and q, with y in units of its deviation, and how many episodes they are of."""

    s: Float[Array, "features features"]
    p: Float[Array, " features"]
    q: Float[Array, ""]
    free: Float[Array, ""]
    """N - 1."""
    unit: Float[Array, ""]
    """Deviation of y."""
    group: Int[np.ndarray, " features"]
    equal: Float[Array, " groups"]
    """The alpha of each group with which all explain equal parts of the returns, half of them in all."""


def problem(sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"]) -> Problem:
    """The regression of R/T (`form` 0) or of R (1)."""
    features = len(group)
    column = features + form
    unit = jnp.sqrt(sums.products[column, column] / jnp.maximum(sums.steps, 1))
    unit = jnp.where(unit > 1e-6 * jnp.abs(sums.mean[column]), unit, 0)  # float32 makes so much of a constant
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
    """The posterior under the precisions that the fixed point leads to.

    Args:
        sums: over the episodes.
        form: 0 where the score is a sum over the steps, 1 where it is an average.
        group: the number of each feature's group.
        start: an earlier fit, with whose precisions the first round begins; or `unknown`.
        rounds: at most; there are fewer where the evidence stops changing.
    """
    given = problem(sums, form, group)
    alpha = jnp.where(start.alpha > 0, start.alpha, given.equal)
    beta = jnp.where(start.beta > 0, start.beta, 2 * given.free / given.q)
    first = one_round(given, alpha, beta)

    def unsettled(state: tuple[Int[Array, ""], Float[Array, ""], Posterior]) -> Bool[Array, ""]:
        done, before, known = state
        return (done < rounds) & (jnp.abs(known.log_evidence - before) > GAIN)

    def again(
        state: tuple[Int[Array, ""], Float[Array, ""], Posterior],
    ) -> tuple[Int[Array, ""], Float[Array, ""], Posterior]:
        done, _, known = state
        return done + 1, known.log_evidence, one_round(given, known.alpha, known.beta)

    begin = jnp.array(1), jnp.full_like(first.log_evidence, -jnp.inf), first
    found = jax.lax.while_loop(unsettled, again, begin)[2]
    enough = (given.free > 0) & (given.unit > 0)
    found = jax.tree.map(lambda new, old: jnp.where(enough, new, old), found, start)
    weight = jnp.where(enough, given.unit * found.weight, 0)
    bias = sums.mean[len(group) + form] - weight @ sums.mean[: len(group)]
    return found._replace(weight=weight, bias=bias)


def within(
    given: Problem, alpha: Float[Array, " groups"], beta: Float[Array, ""]
) -> tuple[Float[Array, " groups"], Float[Array, ""]]:
    """Precisions that float32 can calculate with."""
    of_all = jnp.maximum(given.free, 1) / given.q  # where all is noise
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
    """How far off b + w . f may be: its posterior variance is |root (f - centre)|^2 + of_mean, in squared units of y."""

    root: Float[Array, "*forms features features"]
    """root^T root = Sigma."""
    centre: Float[Array, "*forms features"]
    """m'."""
    of_mean: Float[Array, "*forms"]
    """The variance of y', the mean reward at the centre."""


def spread(sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"], known: Posterior) -> Spread:
    """Of a posterior. Prior deviations where nothing is known of a feature; 0 where no two returns differ yet."""
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
