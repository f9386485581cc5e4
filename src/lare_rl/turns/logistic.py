"""The value of a prefix with a logistic likelihood, for outcomes between 0 and 1.

    P(R_k = 1) = s(eta),    eta = m + b_group(k) + v . x_kt,    s the logistic function

Laplace's approximation: Newton's method to the most likely (v, m, b), where each step is the weighted regression of `regression.py` on
the working response eta + (y - p) / (p (1 - p)), with the weights w p (1 - p) and noise of variance 1. The precisions alpha follow
the same rule, alpha_i = gamma_i / mu_i^2. The bound of `credit/logistic.py` does not replace it: `value.py` leaves out single rollouts
by a step of Newton's method, which needs the curvature of the likelihood, not of the bound.
"""

import numpy as np
from jaxtyping import Float, Int

from lare_rl.credit.precisions import NUMPY_BACKEND, TOLERANCE
from lare_rl.turns.regression import Elimination, GroupSums, PrefixFit, eliminate_groups, sum_up, to_fit

__all__ = ["fit_logistic", "logistic"]

MAX_ROUNDS = 25
"""The largest number of rounds: of precisions, and Newton's steps under each of them."""
FIRST_STEPS, NEXT_STEPS = 8, 2
"""The largest number of steps in the first round, and in each further one."""
MAX_LOG_ODDS = 30.0
MAX_STEP = 5.0
"""The largest change of the log odds of a prefix in one step."""
WEAKEST, STRONGEST = 1e-4, 1e5
"""The smallest and the largest precision of a feature, relative to its first one."""
MIN_CURVATURE = 1e-6


def logistic(log_odds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return 1 / (1 + exp(-x)), without overflow."""
    return 1 / (1 + np.exp(-np.clip(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)))


def fit_logistic(
    x: Float[np.ndarray, "prefixes features"],
    y: Float[np.ndarray, " prefixes"],
    weight: Float[np.ndarray, " prefixes"],
    group: Int[np.ndarray, " prefixes"],
    n_rollouts: int,
) -> PrefixFit:
    """Return the posterior of the log odds. The arguments are those of `fit_linear`; y is between 0 and 1."""
    rate = np.clip(weight @ y / weight.sum(), 0.02, 0.98)
    eta = np.full(len(y), np.log(rate / (1 - rate)))

    def regress(eta: np.ndarray) -> GroupSums:
        """Return the sums of the regression on the working response."""
        p = logistic(eta)
        curvature = np.maximum(p * (1 - p), MIN_CURVATURE)
        return sum_up(x, eta + (y - p) / curvature, weight * curvature, group, n_rollouts, unit=1.0)

    def newton(
        eta: np.ndarray, sums: GroupSums, alpha: np.ndarray, max_steps: int
    ) -> tuple[np.ndarray, GroupSums, Elimination]:
        """Return the log odds after Newton's steps from `eta` and its sums, with the sums and the posterior of the last step."""
        while True:
            posterior = eliminate_groups(sums, alpha, 1.0)
            mean = sums.problem.y_mean + posterior.weight[-1]
            step = mean + (x - sums.x_mean) @ posterior.weight[:-1] + posterior.intercept[group] - eta
            largest = np.abs(step).max()
            eta = eta + step * min(1.0, MAX_STEP / max(largest, 1e-12))
            max_steps -= 1
            if largest < 1e-3 or not max_steps:
                return eta, sums, posterior
            sums = regress(eta)

    sums = regress(eta)
    problem = sums.problem
    first_alpha = np.append(np.diagonal(problem.s) / problem.q * x.shape[1], 1.0) + 1e-12
    alpha, log_evidence = first_alpha, -np.inf
    eta, sums, posterior = newton(eta, sums, alpha, FIRST_STEPS)
    for _ in range(MAX_ROUNDS - 1):
        solution = np.concatenate([posterior.weight[:-1], posterior.intercept])
        moments = solution, posterior.variance, posterior.log_det
        _, alpha, log_occam = NUMPY_BACKEND.update_alpha(problem.alpha_index, alpha, *moments)
        alpha = np.clip(alpha, first_alpha * WEAKEST, first_alpha * STRONGEST)
        p = np.clip(logistic(eta), 1e-12, 1 - 1e-12)
        previous, log_evidence = log_evidence, weight @ (y * np.log(p) + (1 - y) * np.log(1 - p)) + log_occam
        if abs(log_evidence - previous) <= 10 * TOLERANCE:
            break
        eta, sums, posterior = newton(eta, regress(eta), alpha, NEXT_STEPS)
    return to_fit(sums, posterior, 1.0, is_logistic=True)
