"""Values of prefixes from a fit, and what follows from them: changes of value, advantages, posterior standard deviations.

With b_(-k) the intercept of the group without rollout k itself:

    V_kt    = m + b_(-k) + v . x_kt
    delta_t = V_(t+1) - V_t,   and   R - V_t at the last turn         (they add up to R - V_0)
    A_t     = sum_l lambda^l delta_(t+l)                              (generalized advantages, Schulman et al., 2016)

The posterior standard deviation of a change is sqrt((x_(t+1) - x_t)^T Sigma (x_(t+1) - x_t)); at the last turn, that of V_t. If the
log odds are linear, V is the logistic function of them, b_(-k) follows from one step of Newton's method, and standard deviations from
the slopes of V.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.turns.features import TurnTable
from lare_rl.turns.logistic import fit_logistic, logistic
from lare_rl.turns.regression import PrefixFit, fit_linear

__all__ = ["advantages", "changes", "fit_prefixes", "held_out_values", "posterior_stds", "values"]

MAX_NUMBERS = 4_000_000
"""The size of the largest array of covariances."""


def fit_prefixes(table: TurnTable, x: Float[np.ndarray, "turns features"], *, is_logistic: bool = False) -> PrefixFit:
    """Return the fit of the outcomes to the features of all prefixes."""
    index, n_rollouts = table.rollout_index, len(table.length)
    fit = fit_logistic if is_logistic else fit_linear
    return fit(x, table.outcome[index], np.full(len(x), n_rollouts / len(x)), table.group[index], n_rollouts)


class _Predictions(NamedTuple):
    """Predictions for each prefix, and the derivatives of the log likelihood of its outcome."""

    eta: Float[np.ndarray, " turns"]
    """The value or, if the fit is logistic, its log odds."""
    value: Float[np.ndarray, " turns"]
    slope: Float[np.ndarray, " turns"]
    """The derivative of the value with respect to eta."""
    gradient: Float[np.ndarray, " turns"]
    """The derivative of the log likelihood with respect to eta."""
    curvature: Float[np.ndarray, " turns"]
    """Its second derivative, with the opposite sign."""


def _predict(table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit) -> _Predictions:
    """Return predictions with the intercept of each rollout's group."""
    index = table.rollout_index
    eta = fit.mean + (x - fit.x_mean) @ fit.weight + fit.intercept[table.group][index]
    value = logistic(eta) if fit.is_logistic else eta
    slope = value * (1 - value) if fit.is_logistic else np.ones_like(eta)
    weight = len(table.length) / len(x) / fit.noise_variance
    gradient = weight * (table.outcome[index] - value)
    return _Predictions(eta=eta, value=value, slope=slope, gradient=gradient, curvature=weight * slope)


def values(table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit) -> Float[np.ndarray, " turns"]:
    """Return V of the prefix before each turn. The intercept of a rollout's group leaves out the rollout itself."""
    predictions, index = _predict(table, x, fit), table.rollout_index
    gradient, curvature = (np.bincount(index, terms) for terms in (predictions.gradient, predictions.curvature))
    change = gradient / np.maximum(fit.group_precision[table.group] - curvature, 1e-12)
    eta = predictions.eta - change[index]
    return logistic(eta) if fit.is_logistic else eta


def changes(table: TurnTable, value: Float[np.ndarray, " turns"]) -> Float[np.ndarray, " turns"]:
    """Return the change of value of each turn. The changes of a rollout add up to its outcome minus its first value."""
    next_value = np.append(value[1:], 0)
    next_value[table.last] = table.outcome
    return next_value - value


def advantages(table: TurnTable, change: Float[np.ndarray, " turns"], lambda_: float) -> Float[np.ndarray, " turns"]:
    """Return A_t = sum_l lambda^l delta_(t+l) within each rollout."""
    advantage = np.copy(change)
    turns_left = np.repeat(table.last, table.length) - np.arange(len(change))
    rows = np.argsort(turns_left, kind="stable")
    ends = np.cumsum(np.bincount(turns_left))
    for start, stop in itertools.pairwise(ends):  # all rollouts at once, from their ends
        advantage[rows[start:stop]] += lambda_ * advantage[rows[start:stop] + 1]
    return advantage


def posterior_stds(
    table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit
) -> Float[np.ndarray, " turns"]:
    """Return the posterior standard deviation of each change of value."""
    slope, last = _predict(table, x, fit).slope, table.last
    rows = slope[:, None] * _rows(table, x, fit)
    change, slope_change = np.diff(rows, axis=0, append=0), np.diff(slope, append=0)
    change[last], slope_change[last] = rows[last], slope[last]
    variance = np.sum((change @ fit.root.T) ** 2, axis=1)
    return np.sqrt(variance + slope_change**2 / fit.group_precision[table.group][table.rollout_index])


def _rows(table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit) -> Float[np.ndarray, "turns n"]:
    """Return the derivative of eta with respect to (v, m), of which b is a function."""
    return np.column_stack([x - fit.x_mean, np.ones(len(x))]) - fit.group_row[table.group][table.rollout_index]


def _equal_lengths(length: Int[np.ndarray, " rollouts"]) -> Iterator[tuple[int, Int[np.ndarray, " some"]]]:
    """Yield rollouts of equal length, at most so many that a matrix for each of them has `MAX_NUMBERS` numbers in all."""
    for size in np.unique(length).tolist():
        rollouts = np.flatnonzero(length == size)
        yield from ((size, chunk) for chunk in np.array_split(rollouts, -(-len(rollouts) * size**2 // MAX_NUMBERS)))


def held_out_values(
    table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit
) -> Float[np.ndarray, " turns"]:
    """Return V from the fit to all other rollouts, under the same precisions.

    With C the posterior covariance of eta at the prefixes of a rollout, and g and diag(h) the first two derivatives of its log likelihood,
    eta without the rollout is eta - (I - C diag(h))^-1 C g. This is exact if the value is linear, else one step of Newton's method.
    """
    predictions = _predict(table, x, fit)
    rows = _rows(table, x, fit) @ fit.root.T
    eta = np.empty_like(predictions.eta)
    for size, rollouts in _equal_lengths(table.length):
        index = table.first[rollouts][:, None] + np.arange(size)
        block = rows[index]
        covariance = block @ block.swapaxes(1, 2) + 1 / fit.group_precision[table.group[rollouts]][:, None, None]
        # A single rollout determines m alone: without this, the system would be singular.
        system = (1 + 1e-9) * np.eye(size) - covariance * predictions.curvature[index][:, None, :]
        change = np.linalg.solve(system, covariance @ predictions.gradient[index][..., None])
        eta[index] = predictions.eta[index] - change[..., 0]
    return logistic(eta) if fit.is_logistic else eta
