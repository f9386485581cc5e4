"""What the credit of prefixes is compared with. Each function returns one number for each turn, to be used as its advantage."""

from functools import partial

import numpy as np
from jaxtyping import Float, Int

from lare_rl.credit.precisions import JITTER, NUMPY_BACKEND, Regression
from turns.finite_task import Rollouts, Task

__all__ = ["gigpo", "grpo", "summed_credit"]

Turns = Float[np.ndarray, "rollouts turns"]
ROUNDS = 40


def grpo(task: Task, rollouts: Rollouts) -> Turns:
    """Return the outcome minus the mean of the group, for every turn. (Shao et al., 2024, without division by the deviation.)"""
    return (rollouts.outcome - _means(rollouts.outcome, rollouts.group))[:, None] * rollouts.mask


def gigpo(task: Task, rollouts: Rollouts, discount: float = 0.95) -> Turns:
    """Return GRPO's advantage plus that among turns of the group with the same state (Feng et al., 2025), without deviations."""
    mask, anchor = rollouts.mask, task.anchor[rollouts.state]
    turns_left = rollouts.length[:, None] - 1 - np.arange(mask.shape[1])
    returns = (discount ** np.maximum(turns_left, 0) * rollouts.outcome[:, None])[mask]
    key = (rollouts.group[:, None] * (task.anchor.max() + 1) + anchor)[mask]
    advantage = grpo(task, rollouts)
    advantage[mask] += returns - _means(returns, np.unique(key, return_inverse=True)[1])
    return advantage


def summed_credit(task: Task, rollouts: Rollouts) -> Turns:
    """Return LaRe's proxy rewards as advantages: scores of turns whose sum predicts the outcome. This must not be done.

    The scores are linear in the features of a turn, fitted as `credit/evidence.py` says, with one group. Their mean is subtracted.
    """
    length, mask = rollouts.length.astype(float), rollouts.mask
    mean = rollouts.features.sum(axis=1) / length[:, None]
    score = _fit(mean, rollouts.outcome / length, length)
    credit = rollouts.features @ score
    return (credit - credit[mask].mean()) * mask


def _fit(
    x: Float[np.ndarray, "rollouts features"], y: Float[np.ndarray, " rollouts"], weight: Float[np.ndarray, " rollouts"]
) -> Float[np.ndarray, " features"]:
    """Return the weights of the evidence's regression of y on x."""
    total, alpha_index = weight.sum(), np.zeros(x.shape[1], int)
    x, y = x - weight @ x / total, y - weight @ y / total
    y_std = np.sqrt(weight @ y**2 / total)
    if y_std == 0:
        return np.zeros(x.shape[1])
    s = (weight[:, None] * x).T @ x
    s += JITTER * np.diag(np.diagonal(s))
    p = (weight[:, None] * x).T @ y / y_std
    equal_alpha = NUMPY_BACKEND.equal_alpha(np.diagonal(s), total, alpha_index)
    problem = Regression(s, p, total, np.asarray(len(y) - 1.0), np.zeros(()), y_std, alpha_index, equal_alpha)
    alpha, beta, weight = equal_alpha, 2 * problem.dof / total, np.zeros(x.shape[1])
    moments = partial(NUMPY_BACKEND.dense_moments, problem)
    for _ in range(ROUNDS):
        posterior = NUMPY_BACKEND.next_posterior(problem, alpha, beta, moments)
        weight, alpha, beta = posterior.weight, posterior.alpha, posterior.beta
    return y_std * weight


def _means(values: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the mean of each value's group."""
    return (np.bincount(group, values) / np.bincount(group))[group]
