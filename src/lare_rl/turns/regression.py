"""The value of a prefix in closed form: a regression of outcomes on features of prefixes, with an intercept for each group.

There is one case for each turn t of each rollout k. Its features x_kt describe what happened before the turn, the prefix, and its outcome
is that of the whole rollout, R_k. With x' the mean of the features:

    R_k = m + b_group(k) + v . (x_kt - x') + e,     b ~ N(0, 1 / alpha_0),     v_i ~ N(0, 1 / alpha_i),     e ~ N(0, 1 / beta)

Every case has the weight w = 1 / (mean length of a rollout), so that the weights add up to the number of rollouts. (The weight 1 / T_k
would be wrong: the length T_k depends on what the agent does later.) m has a flat prior. The precisions maximise the evidence, by the
rounds of `credit/precisions.py`.

There is an intercept for each group, but their block of the posterior's precision is diagonal. So they are eliminated. With the sums
X = sum w (x - x') and W = sum w in each group, and P the precision of (v, m) for known intercepts:

    D = beta W + alpha_0,     B = beta (X, W),     precision of (v, m) = P - B^T D^-1 B

This needs a matrix of the size of v, whatever the number of groups.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.credit.precisions import JITTER, NUMPY_BACKEND, TOLERANCE, Moments, Posterior, Regression, varies

__all__ = [
    "GroupSums",
    "PrefixFit",
    "fit_linear",
    "fixed_point",
    "group_moments",
    "sum_up",
]

MAX_ROUNDS = 40
"""The maximum number of rounds of the evidence's fixed point, from each of its two starts."""
NOISE_ONLY = 1e3
"""In the second start, each prior variance is smaller than for equal shares by this factor."""


class GroupSums(NamedTuple):
    """Weighted sums over prefixes, about the means, and their sums in each group. y is in units of its standard deviation."""

    x_mean: Float[np.ndarray, " features"]
    group_x: Float[np.ndarray, "groups features"]
    """X."""
    group_y: Float[np.ndarray, " groups"]
    """sum w (y - y_mean) / y_std in each group."""
    group_weight: Float[np.ndarray, " groups"]
    """W."""
    total_weight: float
    """sum w, over all groups. It is also the sum of w y^2 (`Regression.q`), because y has the variance 1."""
    problem: Regression
    """The regression on (v, b). S = sum w (x - x_mean)(x - x_mean)^T is only that of v. p = sum w (x - x_mean) y and then `group_y`."""


class PrefixFit(NamedTuple):
    """The posterior of (v, m, b)."""

    x_mean: Float[np.ndarray, " features"]
    coefficients: Float[np.ndarray, " features"]
    """v."""
    mean: float
    """m."""
    intercept: Float[np.ndarray, " groups"]
    """b."""
    root: Float[np.ndarray, "v_and_m v_and_m"]
    """root^T root is the covariance of (v, m)."""
    group_row: Float[np.ndarray, "groups v_and_m"]
    """D^-1 B: how much the mean of b falls if an entry of (v, m) grows by 1."""
    group_precision: Float[np.ndarray, " groups"]
    """D: the precision of b if (v, m) is known."""
    noise_variance: float
    """1 / beta, the variance of e."""


def sum_up(
    x: Float[np.ndarray, "prefixes features"],
    y: Float[np.ndarray, " prefixes"],
    weight: Float[np.ndarray, " prefixes"],
    group: Int[np.ndarray, " prefixes"],
    n_rollouts: int,
) -> GroupSums:
    """Return the sums over prefixes, with the outcomes y in units of their standard deviation.

    Groups without a prefix are allowed. The degrees of freedom are those of the rollouts, because all prefixes of a rollout have the
    same outcome.
    """
    n_groups, total = int(group.max()) + 1, weight.sum()
    x_mean, y_mean = weight @ x / total, weight @ y / total
    x_centred, y_centred = x - x_mean, y - y_mean
    size = np.maximum(np.abs(x).max(axis=0, initial=0), 1e-300)  # features of turns are not standardised
    x_centred = np.where(varies(weight @ (x_centred / size) ** 2 / total, (x_mean / size) ** 2), x_centred, 0)
    y_std = np.sqrt(weight @ y_centred**2 / total)
    if not y_std > 1e-9 * np.abs(y).max(initial=0):
        y_mean, y_std, y_centred = y[0], 0.0, np.zeros_like(y)  # the mean of equal numbers has a rounding error
    weighted = weight[:, None] * x_centred
    s = weighted.T @ x_centred
    s += JITTER * np.diag(np.diagonal(s))
    scaled = weight * y_centred / (y_std or 1)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    group_x = np.zeros((n_groups, x.shape[1]))
    group_x[group[order][starts]] = np.add.reduceat(weighted[order], starts, axis=0)
    group_y, group_weight = (np.bincount(group, values, n_groups) for values in (scaled, weight))
    alpha_index = np.concatenate([np.arange(x.shape[1]), np.full(n_groups, x.shape[1])])
    # Of S for v and b. That of b is the sum of w (i - W / sum w)^2, where i is 1 in the group and 0 elsewhere.
    diagonal = np.concatenate([np.diagonal(s), group_weight - group_weight**2 / total])
    problem = Regression(
        s=s,
        p=np.concatenate([scaled @ x_centred, group_y]),
        q=total,
        dof=np.asarray(n_rollouts - 1.0),
        y_mean=y_mean,
        y_std=np.asarray(y_std),
        alpha_index=alpha_index,
        equal_alpha=NUMPY_BACKEND.equal_alpha(diagonal, total, alpha_index),
    )
    return GroupSums(x_mean, group_x, group_y, group_weight, total, problem)


class _Elimination(NamedTuple):
    """The posterior of (v, m), and of b if (v, m) is known. y is in units of its standard deviation, and m relative to its mean."""

    root: Float[np.ndarray, "v_and_m v_and_m"]
    log_det: float
    """log det of the precision of (v, b)."""
    coefficients: Float[np.ndarray, " v_and_m"]
    """(v, m)."""
    intercept: Float[np.ndarray, " groups"]
    group_row: Float[np.ndarray, "groups v_and_m"]
    group_precision: Float[np.ndarray, " groups"]

    @property
    def variance(self) -> Float[np.ndarray, " features_and_groups"]:
        """The posterior variance of v and of b."""
        group_variance = 1 / self.group_precision + np.sum((self.group_row @ self.root.T) ** 2, axis=1)
        return np.concatenate([np.sum(self.root[:, :-1] ** 2, axis=0), group_variance])


def _eliminate_groups(sums: GroupSums, alpha: Float[np.ndarray, " alphas"], beta: float) -> _Elimination:
    """Return the posterior under some precisions. D and B are those of the equations above."""
    problem, n = sums.problem, len(sums.x_mean)
    d = beta * sums.group_weight + alpha[-1]
    rows = beta * np.column_stack([sums.group_x, sums.group_weight])
    precision = np.diag(np.append(alpha[:-1], beta * sums.total_weight))
    precision[:n, :n] += beta * problem.s
    group_row = rows / d[:, None]
    root, log_det = NUMPY_BACKEND.inverse_root(precision - rows.T @ group_row)
    right = beta * (np.append(problem.p[:n], 0) - group_row.T @ sums.group_y)  # 0 for m, because y is centred
    coefficients = root.T @ (root @ right)
    intercept = beta * sums.group_y / d - group_row @ coefficients
    # The flat prior of m is integrated out: that takes the precision of m itself from the determinant.
    log_det = log_det + np.log(d).sum() - np.log(beta * sums.total_weight)
    return _Elimination(
        root=root,
        log_det=log_det,
        coefficients=coefficients,
        intercept=intercept,
        group_row=group_row,
        group_precision=d,
    )


def group_moments(sums: GroupSums, alpha: Float[np.ndarray, " alphas"], beta: float) -> Moments:
    """Return the moments of (v, b), as `precisions.dense_moments` of the whole matrix S would."""
    problem, posterior = sums.problem, _eliminate_groups(sums, alpha, beta)
    v, b = posterior.coefficients[:-1], posterior.intercept
    v_and_b = np.concatenate([v, b])
    squares = v @ problem.s @ v + 2 * b @ (sums.group_x @ v)
    squares += sums.group_weight @ b**2 - (sums.group_weight @ b) ** 2 / sums.total_weight
    residual = problem.q - 2 * v_and_b @ problem.p + squares
    return Moments(v_and_b, posterior.variance, posterior.log_det, residual)


def fit_linear(
    x: Float[np.ndarray, "prefixes features"],
    y: Float[np.ndarray, " prefixes"],
    weight: Float[np.ndarray, " prefixes"],
    group: Int[np.ndarray, " prefixes"],
    n_rollouts: int,
) -> PrefixFit:
    """Return the posterior under the precisions that maximise the evidence. The arguments are those of `sum_up`.

    The evidence may have a maximum where all variation is noise. So there are two iterations, from equal shares and from much smaller
    ones. The result with the larger evidence is returned.
    """
    sums = sum_up(x, y, weight, group, n_rollouts)
    problem = sums.problem
    beta = 2 * problem.dof / problem.q  # the features explain half of the variance
    candidates = [fixed_point(sums, problem.equal_alpha * factor, beta) for factor in (1.0, NOISE_ONLY)]
    best = max(candidates, key=lambda posterior: posterior.log_evidence)
    alpha, beta = NUMPY_BACKEND.clip_precisions(problem, best.alpha, best.beta)
    posterior, unit = _eliminate_groups(sums, alpha, beta), float(problem.y_std)
    return PrefixFit(
        x_mean=sums.x_mean,
        coefficients=unit * posterior.coefficients[:-1],
        mean=float(problem.y_mean + unit * posterior.coefficients[-1]),
        intercept=unit * posterior.intercept,
        root=unit * posterior.root,
        group_row=posterior.group_row,
        group_precision=posterior.group_precision / (unit or 1) ** 2,
        noise_variance=(unit or 1) ** 2 / float(beta),
    )


def fixed_point(
    sums: GroupSums, alpha: Float[np.ndarray, " alphas"], beta: float, max_rounds: int = MAX_ROUNDS
) -> Posterior:
    """Iterate from some precisions until the evidence stops changing: `credit.evidence.fixed_point`, in NumPy."""
    next_posterior = partial(NUMPY_BACKEND.next_posterior, sums.problem, moments=partial(group_moments, sums))
    posterior = next_posterior(alpha, beta)
    for _ in range(max_rounds - 1):
        previous, posterior = posterior, next_posterior(posterior.alpha, posterior.beta)
        if abs(posterior.log_evidence - previous.log_evidence) <= TOLERANCE:
            break
    return posterior
