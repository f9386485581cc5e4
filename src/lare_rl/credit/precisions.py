"""One round of the evidence's fixed point (`evidence.py`), for arrays of NumPy and of JAX.

The equations are those of `evidence.py`. They are methods of `Backend`, which holds the array library. The loops over rounds are in
`evidence.py` and `turns/regression.py`. The caller computes the `Moments` of the posterior: by `dense_moments`, or faster if S has a
structure, as in `turns/regression.py`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = [
    "JITTER",
    "NUMPY_BACKEND",
    "PRIOR_RANGE",
    "TOLERANCE",
    "AlphaIndex",
    "Backend",
    "Features",
    "Moments",
    "Posterior",
    "Regression",
    "expand_groups",
    "n_alphas",
    "varies",
]

PRIOR_RANGE = 1e6
"""alpha stays within this factor of `Regression.equal_alpha`. Without a limit, a group that was switched off could not be switched on
again."""
JITTER = 1e-10
"""This fraction of the diagonal of S is added to S, so that S can be factorised if features are collinear."""
TOLERANCE = 1e-3
"""The iteration to the fixed point ends when a round changes the log evidence by less than this."""
MIN_VARIATION = 1e-5
"""A feature is constant if its standard deviation between cases is below this fraction of sqrt(1 + mean^2), as the mean time of equally
long episodes is: a weight for it would be the quotient of two rounding errors. So features must have a size of about 1, or more."""
MANY_EPISODES_PER_FEATURE = 2
"""With fewer episodes for each feature, the evidence may have several maxima (`evidence.fit`)."""
MIN_NOISE = 1e-10
"""The smallest variance of the noise, relative to that of the returns. Float32 features and returns cannot resolve less."""

Array = Any
"""An array of NumPy or of JAX. (jaxtyping's `Array` would import JAX.)"""
Features = Float[Array, " features"]
Alphas = Float[Array, " alphas"]
AlphaIndex = Int[np.ndarray, " features"]
"""For each feature, the index of its precision in alpha: that of its group, or of its strength (`relevance.py`)."""


class Posterior(NamedTuple):
    """The posterior of the weights, without their covariance, which `evidence.posterior_covariance` computes.

    During the iteration, y is in units of its standard deviation and the bias is 0. `evidence.unscale` returns to the unit of y.
    """

    weight: Float[Array, "*batch features"]
    bias: Float[Array, "*batch"]
    alpha: Float[Array, "*batch alphas"]
    """The precisions of the weights in the next round, one for each group or strength, always with y in units of its standard deviation."""
    beta: Float[Array, "*batch"]
    """The precision of a step's noise in the next round, with y in the same units."""
    n_effective: Float[Array, "*batch alphas"]
    """gamma: for each alpha, how many of its features the data determine."""
    log_evidence: Float[Array, "*batch"]
    """The log evidence of the precisions of this round, up to a constant that does not depend on groups and precisions. 0 in
    `logistic.py`."""

    @property
    def has_fit(self) -> Bool[Array, "*batch"]:
        """Whether this is the result of a fit. The precisions are 0 before the first one."""
        return self.beta > 0


class Regression(NamedTuple):
    """A regression problem. S, p and q are those of `evidence.py`, with y in units of its standard deviation."""

    s: Float[Array, "features features"]
    p: Features
    q: Float[Array, ""]
    dof: Float[Array, ""]
    """N - 1 degrees of freedom, for N episodes."""
    y_mean: Float[Array, ""]
    y_std: Float[Array, ""]
    alpha_index: AlphaIndex
    equal_alpha: Alphas
    """The alpha of each group by which all groups explain equal parts of the returns, and together half of them if all of them vary."""

    @property
    def has_many_episodes(self) -> Bool[Array, ""]:
        """Whether there are `MANY_EPISODES_PER_FEATURE` degrees of freedom or more for each feature."""
        return self.dof >= MANY_EPISODES_PER_FEATURE * len(self.alpha_index)


class Moments(NamedTuple):
    """What a round needs of a posterior under some precisions."""

    weight: Features
    variance: Features
    """The diagonal of Sigma."""
    log_det: Float[Array, ""]
    """log det Sigma^-1."""
    residual: Float[Array, ""]
    """q - 2 mu . p + mu . S mu."""


def varies(variance: Features, squared_size: Any) -> Any:
    """Return which features vary between cases by more than rounding errors, which grow with their size."""
    return variance > MIN_VARIATION**2 * (1 + squared_size)


class Backend(NamedTuple):
    """An array library, the two functions that NumPy and JAX name differently, and the equations of a round."""

    xp: Any
    """`numpy` or `jax.numpy`."""
    sum_by_alpha: Callable[[Array, AlphaIndex], Alphas]
    """(values, alpha_index) -> for each alpha, the sum of the values of its features."""
    solve_lower: Callable[[Array, Array], Array]
    """(L, B) -> L^-1 B for a lower triangle L."""

    def equal_alpha(self, diagonal: Features, q: Any, alpha_index: AlphaIndex) -> Alphas:
        """Return `Regression.equal_alpha` from the diagonal of S."""
        trace = self.sum_by_alpha(diagonal, alpha_index)
        return self.xp.where(trace > 0, 2 * len(trace) * trace / q, 1)

    def clip_alpha(self, alpha: Alphas, equal_alpha: Alphas) -> Alphas:
        """Clip alpha to `PRIOR_RANGE` around equal shares."""
        return self.xp.clip(alpha, equal_alpha / PRIOR_RANGE, equal_alpha * PRIOR_RANGE)

    def clip_precisions(self, problem: Regression, alpha: Alphas, beta: Any) -> tuple[Alphas, Any]:
        """Clip alpha, and beta to noise from `MIN_NOISE` of the variation to twice all of it."""
        xp = self.xp
        noise_only = xp.maximum(problem.dof, 1) / problem.q  # beta if all variation is noise
        alpha = self.clip_alpha(alpha, problem.equal_alpha)
        return alpha, xp.clip(beta, noise_only / 2, noise_only / MIN_NOISE)

    def inverse_root(self, precision: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Any]:
        """Return a root, where root^T root is the inverse of a precision matrix, and the log of the matrix's determinant."""
        xp = self.xp
        scale = xp.sqrt(xp.diagonal(precision))  # a diagonal of ones makes the factorisation accurate
        factor = xp.linalg.cholesky(precision / xp.outer(scale, scale))
        root = self.solve_lower(factor, xp.diag(1 / scale))
        return root, 2 * xp.sum(xp.log(xp.diagonal(factor)) + xp.log(scale))

    def dense_moments(self, problem: Regression, alpha: Alphas, beta: Any) -> Moments:
        """Return the moments of the posterior under some precisions, from the whole matrix S."""
        xp = self.xp
        root, log_det = self.inverse_root(beta * problem.s + xp.diag(alpha[problem.alpha_index]))
        weight = beta * ((root @ problem.p) @ root)
        residual = problem.q - 2 * weight @ problem.p + weight @ problem.s @ weight
        return Moments(weight, xp.sum(root**2, axis=0), log_det, residual)

    def update_alpha(
        self, alpha_index: AlphaIndex, alpha: Alphas, weight: Features, variance: Features, log_det: Any
    ) -> tuple[Alphas, Alphas, Any]:
        """Return gamma, the next alpha without limits, and the log Occam factor: log evidence - log likelihood at mu (MacKay, 1992)."""
        xp = self.xp
        size = self.sum_by_alpha(xp.ones_like(weight), alpha_index)
        n_effective = xp.clip(size - alpha * self.sum_by_alpha(variance, alpha_index), 0, size)
        squares = self.sum_by_alpha(weight**2, alpha_index)
        log_occam = 0.5 * (size @ xp.log(alpha) - log_det - alpha @ squares)
        # Without variation, weights are 0, and there is nothing to learn about their precision.
        next_alpha = xp.where(squares > 0, n_effective / xp.where(squares > 0, squares, 1), alpha)
        return n_effective, next_alpha, log_occam

    def next_posterior(
        self, problem: Regression, alpha: Alphas, beta: Any, moments: Callable[[Alphas, Any], Moments]
    ) -> Posterior:
        """Return the posterior under the clipped alpha and beta. Its own alpha and beta are those of the next round."""
        xp = self.xp
        alpha, beta = self.clip_precisions(problem, alpha, beta)
        weight, variance, log_det, residual = moments(alpha, beta)
        residual = xp.maximum(residual, MIN_NOISE * problem.q)
        n_effective, next_alpha, log_occam = self.update_alpha(problem.alpha_index, alpha, weight, variance, log_det)
        log_evidence = 0.5 * (problem.dof * xp.log(beta) - beta * residual) + log_occam
        noise_dof = xp.maximum(problem.dof - xp.sum(n_effective), 0.5)  # also if the weights use all degrees of freedom
        alpha, beta = self.clip_precisions(problem, next_alpha, noise_dof / residual)
        return Posterior(
            weight=weight, bias=xp.zeros(()), alpha=alpha, beta=beta, n_effective=n_effective, log_evidence=log_evidence
        )


NUMPY_BACKEND = Backend(np, lambda values, alpha_index: np.bincount(alpha_index, values), np.linalg.solve)


def n_alphas(alpha_index: AlphaIndex) -> int:
    """Return the size of alpha."""
    return int(alpha_index.max(initial=-1)) + 1


def expand_groups(posterior: Posterior, group_index: AlphaIndex, strength_index: AlphaIndex) -> Posterior:
    """Return a fit by groups as if it were by strengths (`relevance.py`).

    Each strength has the precision of its group, and an equal part of the group's `n_effective`.
    """
    group = group_index[np.unique(strength_index, return_index=True)[1]]  # of each strength
    share = posterior.n_effective / np.bincount(group, minlength=posterior.alpha.shape[-1])
    return posterior._replace(alpha=posterior.alpha[..., group], n_effective=share[..., group])
