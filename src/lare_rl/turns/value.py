"""Values of prefixes from a fit, and what follows from them: changes of value, advantages, posterior standard deviations.

With b_(-k) the intercept of the group without rollout k itself:

    V_kt    = m + b_(-k) + v . x_kt
    delta_t = V_(t+1) - V_t,   and   R - V_t at the last turn         (they add up to R - V_0)
    A_t     = sum_l lambda^l delta_(t+l)                              (generalized advantages, Schulman et al., 2016)

The posterior standard deviation of a change is sqrt((x_(t+1) - x_t)^T Sigma (x_(t+1) - x_t)); at the last turn, that of V_t.
"""

import itertools

import numpy as np
from jaxtyping import Float

from lare_rl.turns.features import TurnTable
from lare_rl.turns.regression import PrefixFit, fit_linear
from lare_rl.util.rounding import ceil_div

__all__ = ["advantages", "changes", "fit_prefixes", "held_out_values", "posterior_stds", "values"]

MAX_NUMBERS = 4_000_000
"""The largest size of an array of covariances, unless a single rollout needs more."""


def fit_prefixes(table: TurnTable, x: Float[np.ndarray, "turns features"]) -> PrefixFit:
    """Return the fit of the outcomes to the features of all prefixes."""
    index, n_rollouts = table.rollout_index, len(table.length)
    return fit_linear(x, table.outcome[index], np.full(len(x), n_rollouts / len(x)), table.group[index], n_rollouts)


def _predict(
    table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit
) -> tuple[Float[np.ndarray, " turns"], float]:
    """Return the prediction for each prefix, with the intercept of its rollout's group, and the precision of its outcome."""
    prediction = fit.mean + (x - fit.x_mean) @ fit.coefficients + fit.intercept[table.group][table.rollout_index]
    return prediction, len(table.length) / len(x) / fit.noise_variance


def values(table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit) -> Float[np.ndarray, " turns"]:
    """Return V of the prefix before each turn. The intercept of a rollout's group leaves out the rollout itself."""
    (prediction, precision), index = _predict(table, x, fit), table.rollout_index
    residual = np.bincount(index, table.outcome[index] - prediction)
    group_precision = fit.group_precision[table.group]
    # Rounding must not make it 0. Its unit is that of 1 / outcome^2.
    remaining_precision = np.maximum(group_precision - precision * table.length, 1e-15 * group_precision)
    return prediction - (precision * residual / remaining_precision)[index]


def changes(table: TurnTable, value: Float[np.ndarray, " turns"]) -> Float[np.ndarray, " turns"]:
    """Return the change of value of each turn."""
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
    rows, last = _rows(table, x, fit), table.last
    change = np.diff(rows, axis=0, append=0)
    change[last] = rows[last]
    variance = np.sum((change @ fit.root.T) ** 2, axis=1)
    if fit.root.any():  # the outcomes differ
        variance[last] += 1 / fit.group_precision[table.group]  # b cancels in the other changes
    return np.sqrt(variance)


def _rows(table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit) -> Float[np.ndarray, "turns n"]:
    """Return the derivative of the prediction with respect to (v, m). b is a function of (v, m)."""
    return np.column_stack([x - fit.x_mean, np.ones(len(x))]) - fit.group_row[table.group][table.rollout_index]


def held_out_values(
    table: TurnTable, x: Float[np.ndarray, "turns features"], fit: PrefixFit
) -> Float[np.ndarray, " turns"]:
    """Return V from the fit to all other rollouts, under the same precisions.

    With p the predictions at the prefixes of a rollout, C their posterior covariance, and h the precision of an outcome, the predictions
    without the rollout are p - (I - h C)^-1 h C (R - p).
    """
    prediction, precision = _predict(table, x, fit)
    residual = table.outcome[table.rollout_index] - prediction
    rows = _rows(table, x, fit) @ fit.root.T
    held_out = np.empty_like(prediction)
    for size in np.unique(table.length).tolist():
        same_length = np.flatnonzero(table.length == size)
        for rollouts in np.array_split(same_length, ceil_div(len(same_length) * size**2, MAX_NUMBERS)):
            index = table.first[rollouts][:, None] + np.arange(size)
            block = rows[index]
            covariance = block @ block.swapaxes(1, 2) + 1 / fit.group_precision[table.group[rollouts]][:, None, None]
            share = precision * covariance
            # A single rollout determines m alone: without this, the system would be singular.
            system = (1 + 1e-9) * np.eye(size) - share
            change = np.linalg.solve(system, share @ residual[index][..., None])
            held_out[index] = prediction[index] - change[..., 0]
    return held_out
