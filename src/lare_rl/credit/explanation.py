"""How much of the variation of returns the factors explain, which factors do, and what correlates with the residual.

Everything is computed from the sums of a closed-form fit; S, p and q are those of `evidence.py`. With N episodes, and precision
beta of the noise of a step, a fit explains the share

    1 - (1 / beta) / (q / (N - 1))

of the variation. This is an R^2 that is corrected for the degrees of freedom of the fit. A factor's part of this share is
proportional to the covariance of its features with the prediction, the sum of their mu_i (S mu)_i. The parts of all factors add up
to the share. A part is negative if the factor offsets others: if it pays less in episodes in which they pay more. The parts of raw
entries are those of a fit on factors and entries together. The correlation of the residual of a fit on the factors alone with the
mean of raw entry j over an episode is

    (p - S mu)_j / sqrt(S_jj (q - 2 mu . p + mu . S mu))

The effect of factor i is g_i(u_i) = w_i . f_i(u_i), the sum of its linear feature and its shapes times their weights. The weights
alone do not tell how the reward rises with the factor, because a sine can take the place of a line. Let C_i be the covariance of
the features f_i over all steps, with the linear feature first. The line that is closest to the effect has the slope and the part of
the effect's variance

    e . w_i,  e = C_i[0] / C_i[0, 0]        (e . w_i)^2 C_i[0, 0] / (w_i . C_i w_i)

and the slopes of two factors have the posterior covariance e_i . Sigma_ij e_j. If a factor has two values, such as an event that
happens or not, all of its features are one line: the slope is known as soon as returns tell what the event pays, though the weights
are not.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.basis import FREQUENCIES, Basis
from lare_rl.credit.decomposition import AVERAGE, SUM
from lare_rl.credit.evidence import Posterior, Problem, Sums

ROUNDS = 100
"""Maximum number of rounds of the evidence's fixed point. It is large because there is no earlier fit to start from."""
SAME = 1e-5
"""Episode means of a standardised factor that deviate by less than this are the same: they differ by rounding."""
SHAPED = 1 + 2 * FREQUENCIES
"""The number of features that a factor has alone: itself and its shapes."""


class Steps(NamedTuple):
    """Sums over steps of the features that each factor has alone, and of their products."""

    number: Float[Array, ""]
    total: Float[Array, "factors own"]
    products: Float[Array, "factors own own"]


class Explanation(NamedTuple):
    """The explanation of one team's score."""

    episodes: Float[Array, ""]
    of_steps: Bool[Array, ""]
    """Whether the shares are of the variation of R/T, not of R: the score is a sum, and episodes differ in length."""
    varied: Bool[Array, " factors"]
    """Whether a factor's mean has differed between episodes by more than rounding."""
    by_factors: Float[Array, ""]
    """Share of the returns' variation that the factors explain, with their shapes and pairs; 0 if there are no factors."""
    by_all: Float[Array, ""]
    """Share of the variation that factors and raw entries explain together."""
    of_entries: Float[Array, " entries"]
    """The part of `by_all` that each raw entry has, with its shapes and half of its pairs."""
    slope: Float[Array, " factors"]
    """How much a step's reward rises if a factor rises by one standard deviation: the slope of the line that is closest to its
    effect in the fit on factors; 0 if its mean has not varied. If the score is an average: the rise for a step of an episode of
    average length."""
    uncertainty: Float[Array, "factors factors"]
    """Posterior covariance of `slope`."""
    linear: Float[Array, " factors"]
    """The part of the variance of each factor's effect that this line has; 1 for a factor without effect."""
    share: Float[Array, " factors"]
    """Share of the returns' variation that each factor explains, with its shapes and half of its pairs; below 0 if it offsets
    others."""
    paired: Float[Array, " factors"]
    """The part of `share` that comes from the factor's pairs with other factors."""
    left: Float[Array, " entries"]
    """Correlation of each raw entry with the residual of the fit on factors; 0 for an entry that has never varied."""


def own_features(basis: Basis) -> Int[np.ndarray, "factors own"]:
    """The indices of the features that each factor has alone, the linear one first."""
    return np.arange(basis.factors)[:, None] + basis.factors * np.arange(SHAPED if basis.extended else 1)


def no_steps(basis: Basis) -> Steps:
    """The sums over no steps."""
    factors, own = own_features(basis).shape
    return Steps(jnp.zeros(()), jnp.zeros((factors, own)), jnp.zeros((factors, own, own)))


def add_steps(
    steps: Steps, features: Float[Array, "*batch features"], counts: Bool[Array, "*batch"], basis: Basis
) -> Steps:
    """Add the features of rows to the sums, in float64. Rows where `counts` is false are ignored."""
    own = jnp.where(counts[..., None, None], features[..., own_features(basis)].astype(float), 0)
    return Steps(
        steps.number + jnp.sum(counts),
        steps.total + jnp.einsum("...fi->fi", own),
        steps.products + jnp.einsum("...fi,...fj->fij", own, own),
    )


def explain(sums: Sums, steps: Steps, form: Int[Array, ""] | int, basis: Basis) -> Explanation:
    """Explain returns by sums over the features of a basis, in float64."""
    group, of_factors = basis.group, basis.of_factors
    whole = evidence.fit(sums, form, group, evidence.unknown(basis.size, len(basis.sizes)), ROUNDS)
    every = evidence.problem(sums, form, group)
    by_all, shaped = explained(every, whole), int(basis.extended)
    part, waves = parts(every, whole, by_all)[~of_factors], shaped * basis.frequencies_of_entries
    of_entries = jnp.add(*of_each(part, basis.used_entries, waves, shaped * basis.paired_entries))
    of_steps, none = (form == SUM) & lengths_differ(sums), jnp.zeros(0)
    if not of_factors.any():
        left = jnp.zeros(basis.used_entries)
        of_none = none, jnp.zeros((0, 0)), none, none, none
        return Explanation(sums.episodes, of_steps, none > 0, jnp.zeros(()), by_all, of_entries, *of_none, left)
    alone, numbers = restricted(sums, np.flatnonzero(of_factors)), group[of_factors]
    fitted = evidence.fit(alone, form, numbers, evidence.unknown(len(numbers), int(numbers.max()) + 1), ROUNDS)
    sigma = evidence.covariance(alone, form, numbers, fitted)
    given = evidence.problem(alone, form, numbers)
    by_factors = explained(given, fitted)
    part = parts(given, fitted, by_factors)
    own, paired = of_each(part, basis.factors, shaped * FREQUENCIES, shaped * basis.factors)
    slope, uncertainty, linear = effects(fitted.weight, sigma, steps, basis)
    # r_hat of an average is divided by T
    length = jnp.where(form == AVERAGE, sums.steps / jnp.maximum(sums.episodes, 1), 1)
    return Explanation(
        sums.episodes,
        of_steps,
        jnp.diagonal(given.s)[: basis.factors] > SAME**2 * sums.steps,
        by_factors,
        jnp.maximum(by_all, by_factors),
        of_entries,
        slope / length,
        uncertainty / length**2,
        linear,
        own + paired,
        paired,
        residual(every, basis, fitted, of_factors),
    )


def lengths_differ(sums: Sums) -> Bool[Array, ""]:
    """Whether R is more than the same multiple of R/T in all episodes, which it is if all of them have one length."""
    length = sums.steps / jnp.maximum(sums.episodes, 1)
    (yy, yr), (_, rr) = sums.products[-2:, -2:]
    return rr - 2 * length * yr + length**2 * yy > 1e-6 * rr


def restricted(sums: Sums, features: Int[np.ndarray, " some"]) -> Sums:
    """The sums over some of the features."""
    size = len(sums.mean) - 2
    keep = np.append(features, [size, size + 1])
    return sums._replace(mean=sums.mean[keep], products=sums.products[np.ix_(keep, keep)])


def explained(given: Problem, known: Posterior) -> Float[Array, ""]:
    """The share of the variation that a fit explains; NaN if returns are too few or do not vary."""
    share = 1 - given.free / (given.q * jnp.where(known.beta > 0, known.beta, 1))
    return jnp.where((given.free > 1) & (given.unit > 0), jnp.clip(share, 0, 1), jnp.nan)


def parts(given: Problem, known: Posterior, share: Float[Array, ""]) -> Float[Array, " features"]:
    """The part of the explained share that each feature has."""
    weight = known.weight / jnp.where(given.unit > 0, given.unit, 1)
    part = weight * (given.s @ weight)
    return share * part / jnp.where(jnp.sum(part) > 0, jnp.sum(part), 1)


def of_each(
    part: Float[Array, " features"], inputs: int, frequencies: int, paired: int
) -> tuple[Float[Array, " inputs"], Float[Array, " inputs"]]:
    """The sums of the features' parts for each factor, or for each entry: of its own features, and of its pairs.

    A pair gives half to each of its inputs. Either all of the inputs are paired, or none.
    """
    single, (one, other) = 1 + 2 * frequencies, np.triu_indices(paired, 1)
    own = jnp.sum(part[: single * inputs].reshape(single, inputs), axis=0)
    pairs = part[single * inputs :] / 2
    return own, jnp.zeros_like(own).at[one].add(pairs).at[other].add(pairs)


def effects(
    weight: Float[Array, " features"], sigma: Float[Array, "features features"], steps: Steps, basis: Basis
) -> tuple[Float[Array, " factors"], Float[Array, "factors factors"], Float[Array, " factors"]]:
    """Slope of each factor's effect, the posterior covariance of these slopes, and the linear part of each effect's variance."""
    own = own_features(basis)
    number = jnp.maximum(steps.number, 1)
    mean = steps.total / number
    covariance = steps.products / number - mean[:, :, None] * mean[:, None, :]
    of_own, of_sigma = weight[own], sigma[own[:, :, None, None], own]
    first = covariance[:, 0, 0]
    line = covariance[:, 0] / jnp.where(first > 0, first, 1)[:, None]
    slope = jnp.sum(line * of_own, axis=1)
    variance = jnp.einsum("fi,fij,fj->f", of_own, covariance, of_own)
    uncertainty = jnp.einsum("fi,figj,gj->fg", line, of_sigma, line)
    return slope, uncertainty, jnp.where(variance > 0, slope**2 * first / jnp.where(variance > 0, variance, 1), 1)


def residual(
    given: Problem, basis: Basis, fitted: Posterior, of_factors: Bool[np.ndarray, " features"]
) -> Float[Array, " entries"]:
    """Correlation of the raw entries with the residual of a fit on the factors. `given` is the problem with all features."""
    unit = jnp.where(given.unit > 0, given.unit, 1)
    weight = jnp.zeros(basis.size).at[np.flatnonzero(of_factors)].set(fitted.weight / unit)
    after = given.p - given.s @ weight
    left = given.q - 2 * weight @ given.p + weight @ given.s @ weight
    first = int(np.sum(of_factors))
    entries = slice(first, first + basis.used_entries)
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(given.s)[entries] * left, 0))
    return jnp.where(size > 0, after[entries] / jnp.where(size > 0, size, 1), 0)
