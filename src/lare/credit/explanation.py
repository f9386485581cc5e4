"""What returns say of the factors: how much of their variation the factors explain, which of them, and what they leave.

From the sums that a fit in closed form goes by (`evidence.py`), with S, p and q as there. With N episodes, a fit under which a
step's noise has precision beta explains the share

    1 - (1 / beta) / (q / (N - 1))

of the variation: as an R^2, but for the freedom that the fit has used up. A factor's share of that is in proportion to the
covariance of its features with the prediction, the sum of their mu_i (S mu)_i, or 0 where that is negative: the shares of all
factors add up to the whole. What a fit on the factors alone leaves correlates with the mean of raw entry j over an episode by

    (p - S mu)_j / sqrt(S_jj (q - 2 mu . p + mu . S mu))
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lare.credit import evidence
from lare.credit.basis import FREQUENCIES, Basis
from lare.credit.evidence import Posterior, Sums

ROUNDS = 100
"""Of the evidence's fixed point: there is no earlier fit to begin with."""


class Explanation(NamedTuple):
    """Of one team's score."""

    episodes: Float[Array, ""]
    by_factors: Float[Array, ""]
    """Share of the returns' variation that the factors explain, with their shapes and pairs; 0 where there are none."""
    by_all: Float[Array, ""]
    """The same, with raw entries too."""
    weight: Float[Array, " factors"]
    """What a step pays more, where a factor is larger by one of its deviations, by the linear part of the fit on factors. Where the
    score is an average: what a step of an episode of average length adds to it."""
    deviation: Float[Array, " factors"]
    """Posterior deviation of that."""
    share: Float[Array, " factors"]
    """Part of the returns' variation that goes with each factor, with its shapes and half of its pairs."""
    left: Float[Array, " entries"]
    """Correlation of each raw entry with what the factors leave; 0 for an entry that never varied."""


def explain(sums: Sums, form: Int[Array, ""] | int, basis: Basis) -> Explanation:
    """The explanation by sums over features of a basis. In float64."""
    group, of_factors = basis.group, basis.of_factors
    whole = evidence.fit(sums, form, group, evidence.unknown(basis.size, len(basis.sizes)), ROUNDS)
    by_all = explained(sums, form, group, whole)
    none = jnp.zeros(0)
    if not of_factors.any():
        left = jnp.zeros(basis.used_entries)
        return Explanation(sums.episodes, jnp.zeros(()), by_all, none, none, none, left)
    alone, numbers = restricted(sums, np.flatnonzero(of_factors)), group[of_factors]
    fitted = evidence.fit(alone, form, numbers, evidence.unknown(len(numbers), int(numbers.max()) + 1), ROUNDS)
    sigma = evidence.covariance(alone, form, numbers, fitted)
    given = evidence.problem(alone, form, numbers)
    unit = jnp.where(given.unit > 0, given.unit, 1)
    part = fitted.weight / unit * (given.s @ (fitted.weight / unit))
    by_factors = explained(alone, form, numbers, fitted)
    share = jnp.maximum(of_each(part, basis), 0)
    share = by_factors * share / jnp.where(jnp.any(share > 0), jnp.sum(share), 1)
    steps = jnp.where(form == 1, sums.steps / jnp.maximum(sums.episodes, 1), 1)  # r_hat of an average is a T-th
    return Explanation(
        sums.episodes,
        by_factors,
        jnp.maximum(by_all, by_factors),
        fitted.weight[: basis.factors] / steps,
        jnp.sqrt(jnp.diagonal(sigma)[: basis.factors]) / steps,
        share,
        residual(sums, form, basis, fitted, of_factors),
    )


def restricted(sums: Sums, features: Int[np.ndarray, " some"]) -> Sums:
    """The sums over some of the features."""
    size = len(sums.mean) - 2
    keep = np.append(features, [size, size + 1])
    return sums._replace(mean=sums.mean[keep], products=sums.products[np.ix_(keep, keep)])


def explained(
    sums: Sums, form: Int[Array, ""] | int, group: Int[np.ndarray, " features"], known: Posterior
) -> Float[Array, ""]:
    """The share of the variation that a fit explains; NaN where there is none."""
    given = evidence.problem(sums, form, group)
    share = 1 - given.free / (given.q * jnp.where(known.beta > 0, known.beta, 1))
    return jnp.where((given.free > 1) & (given.unit > 0), jnp.clip(share, 0, 1), jnp.nan)


def of_each(part: Float[Array, " features"], basis: Basis) -> Float[Array, " factors"]:
    """The parts of features, by the factor that they are of; of a pair, half to each."""
    total = part[: basis.factors]
    if not basis.extended:
        return total
    shapes = part[basis.factors : basis.factors * (1 + 2 * FREQUENCIES)].reshape(2 * FREQUENCIES, basis.factors)
    one, other = np.triu_indices(basis.factors, 1)
    pairs = part[basis.factors * (1 + 2 * FREQUENCIES) :] / 2
    return (total + jnp.sum(shapes, axis=0)).at[one].add(pairs).at[other].add(pairs)


def residual(
    sums: Sums, form: Int[Array, ""] | int, basis: Basis, fitted: Posterior, of_factors: np.ndarray
) -> Float[Array, " entries"]:
    """Correlation of the raw entries with what a fit on the factors leaves."""
    given = evidence.problem(sums, form, basis.group)
    unit = jnp.where(given.unit > 0, given.unit, 1)
    weight = jnp.zeros(basis.size).at[np.flatnonzero(of_factors)].set(fitted.weight / unit)
    after = given.p - given.s @ weight
    left = given.q - 2 * weight @ given.p + weight @ given.s @ weight
    first = int(np.sum(of_factors))
    entries = slice(first, first + basis.used_entries)
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(given.s)[entries] * left, 0))
    return jnp.where(size > 0, after[entries] / jnp.where(size > 0, size, 1), 0)
