"""The value of a prefix in closed form: a regression of outcomes on features of prefixes, with an intercept for each group.

For every prefix (k, t) of every rollout k, before its turn t, with features x_kt and the outcome R_k of the rollout:

    R_k = m + b_group(k) + v . x_kt + e,     b ~ N(0, 1 / alpha_0),     v_i ~ N(0, 1 / alpha_i),     e ~ N(0, 1 / beta)

Every prefix has the weight w = 1 / (mean length of a rollout), so that a rollout counts for one case on average. (The weight 1 / T_k
would be wrong: the length T_k depends on what the agent does later.) m has a flat prior. The precisions maximise the evidence, by the
rounds of `credit/precisions.py`.

The intercepts are as many as there are groups, but their block of the posterior's precision is diagonal. So they are eliminated:

    D = beta n + alpha_0,     B = beta (sums of w x, n) of each group,     H = precision of (v, m) - B^T D^-1 B

which costs a matrix of the size of v, whatever the number of groups.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.credit.precisions import (
    JITTER,
    NUMPY,
    TOLERANCE,
    Moments,
    Posterior,
    Regression,
    clip_precisions,
    equal_shares,
    inverse_root,
    next_posterior,
    varies,
)

__all__ = [
    "Elimination",
    "GroupSums",
    "PrefixFit",
    "eliminate_groups",
    "fit_linear",
    "fixed_point",
    "group_moments",
    "sum_up",
]

MAX_ROUNDS = 40
"""The maximum number of rounds of the evidence's fixed point, from each of its two starts."""
NOISE_ONLY = 1e3
"""The second start: each feature may explain its equal share divided by this."""


class GroupSums(NamedTuple):
    """Weighted sums over prefixes, about the means, and their sums in each group. y is in units of its standard deviation."""

    x_mean: Float[np.ndarray, " features"]
    group_x: Float[np.ndarray, "groups features"]
    """sum w (x - x_mean) in each group."""
    group_y: Float[np.ndarray, " groups"]
    """sum w (y - y_mean) / y_std in each group."""
    group_weight: Float[np.ndarray, " groups"]
    """sum w in each group."""
    problem: Regression
    """The regression on (v, b). Its matrix S is only that of v; p has both."""


class PrefixFit(NamedTuple):
    """The posterior of (v, m, b), about `x_mean`."""

    x_mean: Float[np.ndarray, " features"]
    weight: Float[np.ndarray, " features"]
    """v."""
    mean: float
    """m + v . x_mean."""
    intercept: Float[np.ndarray, " groups"]
    """b."""
    root: Float[np.ndarray, "n n"]
    """root^T root is the covariance of (v, m), n = features + 1."""
    group_row: Float[np.ndarray, "groups n"]
    """D^-1 B: b falls by this much if (v, m) grows by 1."""
    group_precision: Float[np.ndarray, " groups"]
    """D: the precision of b for some (v, m)."""
    noise: float
    """1 / beta, the variance of e. 1 if outcomes are probabilities."""
    is_logistic: bool
    """Whether m + b + v . x is the log odds of the outcome (`logistic.py`)."""


def sum_up(
    x: Float[np.ndarray, "prefixes features"],
    y: Float[np.ndarray, " prefixes"],
    weight: Float[np.ndarray, " prefixes"],
    group: Int[np.ndarray, " prefixes"],
    n_groups: int,
    n_cases: int,
    unit: float | None = None,
) -> GroupSums:
    """Return the sums over prefixes. Groups without a prefix are allowed.

    Args:
        x: features of prefixes.
        y: the outcome of each prefix's rollout.
        weight: of each prefix.
        group: the index of each prefix's group.
        n_groups: the number of groups.
        n_cases: the number of rollouts.
        unit: the unit of y; its standard deviation if it is None.
    """
    total = weight.sum()
    x_mean, y_mean = weight @ x / total, weight @ y / total
    x_centred, y_centred = x - x_mean, y - y_mean
    x_centred = np.where(varies(weight @ x_centred**2 / total, x_mean**2), x_centred, 0)
    y_std = unit or np.sqrt(weight @ y_centred**2 / total)
    if not y_std > 1e-9 * np.abs(y).max(initial=0):
        y_std, y_centred = 0.0, np.zeros_like(y)
    weighted = weight[:, None] * x_centred
    s = weighted.T @ x_centred
    s += JITTER * np.diag(np.diagonal(s))
    scaled = weight * y_centred / (y_std or 1)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    group_x = np.zeros((n_groups, x.shape[1]))
    group_x[group[order][starts]] = np.add.reduceat(weighted[order], starts, axis=0)
    group_y, group_weight = (np.bincount(group, values, n_groups) for values in (scaled, weight))
    strengths = np.concatenate([np.arange(x.shape[1]), np.full(n_groups, x.shape[1])])
    diagonal = np.concatenate([np.diagonal(s), group_weight - group_weight**2 / total])
    problem = Regression(
        s=s,
        p=np.concatenate([scaled @ x_centred, group_y]),
        q=total,
        dof=np.asarray(n_cases - 1.0),
        y_mean=y_mean,
        y_std=np.asarray(y_std),
        group_index=strengths,
        equal_alpha=equal_shares(NUMPY, diagonal, total, strengths),
    )
    return GroupSums(x_mean, group_x, group_y, group_weight, problem)


class Elimination(NamedTuple):
    """The posterior of (v, m), and of b given (v, m)."""

    root: Float[np.ndarray, "n n"]
    log_det: float
    """log det of the precision of (v, b)."""
    weight: Float[np.ndarray, " n"]
    """(v, m)."""
    intercept: Float[np.ndarray, " groups"]
    group_row: Float[np.ndarray, "groups n"]
    group_precision: Float[np.ndarray, " groups"]

    @property
    def variance(self) -> Float[np.ndarray, " features_and_groups"]:
        """The posterior variance of v and of b."""
        group_variance = 1 / self.group_precision + np.sum((self.group_row @ self.root.T) ** 2, axis=1)
        return np.concatenate([np.sum(self.root[:, :-1] ** 2, axis=0), group_variance])


def eliminate_groups(sums: GroupSums, alpha: Float[np.ndarray, " strengths"], beta: float) -> Elimination:
    """Return the posterior under some precisions."""
    problem, n = sums.problem, len(sums.x_mean)
    d = beta * sums.group_weight + alpha[-1]
    rows = beta * np.column_stack([sums.group_x, sums.group_weight])
    precision = np.diag(np.append(alpha[:-1], beta * problem.q))
    precision[:n, :n] += beta * problem.s
    group_row = rows / d[:, None]
    root, log_det = inverse_root(NUMPY, precision - rows.T @ group_row)
    right = beta * (np.append(problem.p[:n], 0) - group_row.T @ sums.group_y)
    weight = root.T @ (root @ right)
    intercept = beta * sums.group_y / d - group_row @ weight
    # The flat prior of m is integrated out: that takes the precision of m itself from the determinant.
    log_det = log_det + np.log(d).sum() - np.log(beta * problem.q)
    return Elimination(root, log_det, weight, intercept, group_row, d)


def group_moments(sums: GroupSums, alpha: Float[np.ndarray, " strengths"], beta: float) -> Moments:
    """Return the moments of (v, b), as `precisions.dense_moments` of the whole matrix S would."""
    problem, posterior = sums.problem, eliminate_groups(sums, alpha, beta)
    v, b = posterior.weight[:-1], posterior.intercept
    weight = np.concatenate([v, b])
    squares = v @ problem.s @ v + 2 * b @ (sums.group_x @ v)
    squares += sums.group_weight @ b**2 - (sums.group_weight @ b) ** 2 / problem.q
    residual = problem.q - 2 * weight @ problem.p + squares
    return Moments(weight, posterior.variance, posterior.log_det, residual)


def fit_linear(
    x: Float[np.ndarray, "prefixes features"],
    y: Float[np.ndarray, " prefixes"],
    weight: Float[np.ndarray, " prefixes"],
    group: Int[np.ndarray, " prefixes"],
    n_cases: int,
) -> PrefixFit:
    """Return the posterior under the precisions that maximise the evidence. The arguments are those of `sum_up`.

    The evidence may have a maximum where all is noise. So there are two iterations, from equal shares and from much smaller ones. The
    larger evidence wins.
    """
    sums = sum_up(x, y, weight, group, int(group.max()) + 1, n_cases)
    problem = sums.problem
    beta = 2 * problem.dof / problem.q
    candidates = [fixed_point(sums, problem.equal_alpha * factor, beta) for factor in (1.0, NOISE_ONLY)]
    best = max(candidates, key=lambda posterior: posterior.log_evidence)
    alpha, beta = clip_precisions(NUMPY, problem, best.alpha, best.beta)
    posterior, unit = eliminate_groups(sums, alpha, beta), float(problem.y_std)
    return PrefixFit(
        x_mean=sums.x_mean,
        weight=unit * posterior.weight[:-1],
        mean=float(problem.y_mean + unit * posterior.weight[-1]),
        intercept=unit * posterior.intercept,
        root=unit * posterior.root,
        group_row=posterior.group_row,
        group_precision=posterior.group_precision / (unit or 1) ** 2,
        noise=(unit or 1) ** 2 / float(beta),
        is_logistic=False,
    )


def fixed_point(
    sums: GroupSums, alpha: Float[np.ndarray, " strengths"], beta: float, max_rounds: int = MAX_ROUNDS
) -> Posterior:
    """Iterate from some precisions until the evidence stops changing: `evidence.fixed_point`, in NumPy."""
    moments = partial(group_moments, sums)
    posterior = next_posterior(NUMPY, sums.problem, alpha, beta, moments)
    for _ in range(max_rounds - 1):
        previous, posterior = posterior, next_posterior(NUMPY, sums.problem, posterior.alpha, posterior.beta, moments)
        if abs(posterior.log_evidence - previous.log_evidence) <= TOLERANCE:
            break
    return posterior
