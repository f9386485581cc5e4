"""Logistic regression of won and lost episodes on sums of features, with one prior precision for each group of features.

A score may have two values: won or lost, delivered or not. With x_k = sum_t f_kt the sum of an episode's features,

    P(R_k is the higher value) = sigmoid(eta_k),      eta_k = b + w . x_k,      w_i ~ N(0, 1 / alpha_g)  for every i in group g

Each step adds w . f_t to the log odds. The likelihood is replaced by a Gaussian lower bound, which touches it at +-xi_k (Jaakkola and
Jordan, *Bayesian parameter estimation via variational methods*, Statistics and Computing 10, 2000):

    lambda_k = tanh(xi_k / 2) / (2 xi_k),     z_k = (won_k - 1/2) / lambda_k,     xi_k^2 = eta_k^2 + var(eta_k)

This lambda is twice theirs. Under the bound, w is the weight of a regression of z on x in which episode k has the noise precision
lambda_k. So each round is a round of `evidence.py` with known noise. While alpha stays the same, no round makes the bound worse. Unlike
Laplace's approximation it needs no step size, even if a plane separates the won from the lost episodes.

The fit reads the last `WINDOW` episodes, because it needs their features again in each round, and not only sums over them.

Proxy rewards are in the unit of the return: a step is paid slope w . f_t, where R = start_value + slope w . x is the
regression of the expected returns on what steps add to the log odds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lare_rl.credit import evidence
from lare_rl.credit.evidence import JAX_BACKEND, PosteriorCovariance
from lare_rl.credit.precisions import JITTER, AlphaIndex, Posterior, varies
from lare_rl.credit.prequential import RETURN_TOLERANCE, ring_slots

__all__ = [
    "WINDOW",
    "LogOddsFit",
    "add_episodes",
    "covariance",
    "fit",
    "from_linear",
    "init",
    "predict",
    "remove_episodes",
    "to_returns",
]

WINDOW = 512
"""The number of last episodes that are fitted."""
XI_TOLERANCE = 1e-3
"""The iteration ends when no xi changes by more than this."""


class LogOddsFit(NamedTuple):
    """The last episodes, in no particular order, and the fit to them."""

    columns: Float[Array, "window columns"]
    """For each episode: the sums of its features, 0 in the column of 1/T if the basis has one, and its level, one-hot."""
    returns: Float[Array, " window"]
    n_episodes: Float[Array, ""]
    """The number of episodes that were ever added."""
    lowest: Float[Array, ""]
    highest: Float[Array, ""]
    """The range of all returns so far, which is that of the score. The last episodes may all be won. Equal values are no range."""
    posterior: Posterior
    """In units of log odds."""
    root: Float[Array, "columns columns"]
    """root^T root = Sigma, the covariance of the weights."""


def init(alpha_index: AlphaIndex) -> LogOddsFit:
    """Return the state without episodes."""
    n_columns = len(alpha_index)
    return LogOddsFit(
        columns=jnp.zeros((WINDOW, n_columns)),
        returns=jnp.zeros(WINDOW),
        n_episodes=jnp.zeros(()),
        lowest=jnp.zeros(()),
        highest=jnp.zeros(()),
        posterior=evidence.init_posterior(alpha_index),
        root=jnp.zeros((n_columns, n_columns)),
    )


def remove_episodes(state: LogOddsFit) -> LogOddsFit:
    """Return the state without its episodes. The next fit starts from the precisions of the last one."""
    return state._replace(n_episodes=jnp.zeros_like(state.n_episodes))


def add_episodes(
    state: LogOddsFit,
    columns: Float[Array, "episodes columns"],
    returns: Float[Array, " episodes"],
    mask: Bool[Array, " episodes"],
) -> LogOddsFit:
    """Add new episodes, at most as many as the window has. Episodes where `mask` is false are ignored."""
    slot = ring_slots(state.n_episodes, mask, WINDOW)
    state = state._replace(
        columns=state.columns.at[slot].set(columns.astype(jnp.float32), mode="drop"),
        returns=state.returns.at[slot].set(returns.astype(jnp.float32), mode="drop"),
        n_episodes=state.n_episodes + jnp.sum(mask, dtype=jnp.float32),
    )
    _, lowest, highest = _valid_range(state)
    return state._replace(lowest=lowest, highest=highest)


def _valid_range(state: LogOddsFit) -> tuple[Bool[Array, " window"], Float[Array, ""], Float[Array, ""]]:
    """Return which slots have an episode, and the lowest and the highest return so far."""
    valid, has_range = jnp.arange(WINDOW) < state.n_episodes, state.highest > state.lowest
    low = jnp.min(state.returns, where=valid, initial=jnp.where(has_range, state.lowest, jnp.inf))
    return valid, low, jnp.max(state.returns, where=valid, initial=jnp.where(has_range, state.highest, -jnp.inf))


_State = tuple[Int[Array, ""], Float[Array, ""], Float[Array, " window"], Posterior, Float[Array, "columns columns"]]
"""The number of rounds so far, the largest change of xi in the last of them, xi, and the fit."""


def fit(
    state: LogOddsFit,
    alpha_index: AlphaIndex,
    is_kept: Bool[Array, " columns"],
    max_rounds: int | Int[Array, ""],
) -> LogOddsFit:
    """Fit to the episodes, from the precisions of the last fit. Call this with float64 enabled.

    Only columns where `is_kept` is true have weights and a covariance that are not 0.

    Returns are divided into won and lost halfway between the lowest and the highest. While all episodes are won, or all are lost, or all
    returns are equal but for rounding errors, nothing changes.
    """
    valid, low, high = _valid_range(state)
    n_episodes = jnp.maximum(jnp.sum(valid), 1)
    x = jnp.where(valid[:, None], state.columns, 0).astype(float)
    won = (state.returns > (low + high) / 2).astype(float)
    is_mixed = jnp.any(valid & (won > 0)) & jnp.any(valid & (won == 0))
    is_mixed &= high - low > RETURN_TOLERANCE * jnp.maximum(jnp.abs(low), jnp.abs(high))
    squares = jnp.sum(jnp.where(valid[:, None], x - jnp.sum(x, axis=0) / n_episodes, 0) ** 2, axis=0)
    # The rounding errors of sums that cancel are as large as those of other sums: one size serves for all columns.
    is_used = varies(squares / n_episodes, jnp.sum(x**2) / (n_episodes * x.shape[1]))
    is_used &= is_kept
    x = jnp.where(is_used, x, 0)
    # By this alpha, all groups together change the log odds of an episode by about 1.
    equal_alpha = JAX_BACKEND.equal_alpha(jnp.where(is_used, squares, 0), 2 * n_episodes, alpha_index)

    def body(carry: _State) -> _State:
        n_rounds, _, xi, posterior, _ = carry
        half = jnp.maximum(xi, 1e-6) / 2
        precision = jnp.where(valid, jnp.tanh(half) / (4 * half), 0)
        target = jnp.where(valid, (won - 0.5) / jnp.where(valid, precision, 1), 0)
        total = jnp.sum(precision)
        x_mean, target_mean = precision @ x / total, precision @ target / total
        difference = x - x_mean
        weighted = precision[:, None] * difference
        s = weighted.T @ difference
        alpha = posterior.alpha
        root, log_det = JAX_BACKEND.inverse_root(s + jnp.diag(JITTER * jnp.diagonal(s) + alpha[alpha_index]))
        weight = (root @ (weighted.T @ (target - target_mean))) @ root
        eta = target_mean + difference @ weight
        variance = jnp.sum((difference @ root.T) ** 2, axis=1) + 1 / total
        n_effective, alpha, _ = JAX_BACKEND.update_alpha(alpha_index, alpha, weight, jnp.sum(root**2, axis=0), log_det)
        posterior = Posterior(
            weight=weight,
            bias=target_mean - x_mean @ weight,
            alpha=JAX_BACKEND.clip_alpha(alpha, equal_alpha),
            beta=jnp.ones(()),  # no noise is fitted: 1 says that there is a fit
            n_effective=n_effective,
            log_evidence=jnp.zeros(()),
        )
        new_xi = jnp.sqrt(eta**2 + variance)
        change = jnp.max(jnp.where(valid, jnp.abs(new_xi - xi), 0))
        return n_rounds + 1, change, new_xi, posterior, root

    def is_unsettled(carry: _State) -> Bool[Array, ""]:
        return (carry[0] < max_rounds) & (carry[1] > XI_TOLERANCE)

    alpha = jnp.where(state.posterior.has_fit, JAX_BACKEND.clip_alpha(state.posterior.alpha, equal_alpha), equal_alpha)
    start = state.posterior._replace(alpha=alpha)
    initial = (jnp.array(0), jnp.array(jnp.inf), jnp.ones(WINDOW), start, state.root)
    initial = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype == jnp.float32 else leaf, initial)
    *_, posterior, root = jax.lax.while_loop(is_unsettled, body, initial)
    fitted = state._replace(posterior=posterior, root=jnp.where(is_kept, root, 0))
    return jax.tree.map(lambda new, old: jnp.where(is_mixed, new, old).astype(old.dtype), fitted, state)


def predict(state: LogOddsFit, columns: Float[Array, "episodes columns"]) -> Float[Array, " episodes"]:
    """Return the expected return of episodes, by the sums of their features. It is NaN before the first episode."""
    _, low, high = _valid_range(state)
    return low + (high - low) * jax.nn.sigmoid(state.posterior.bias + columns @ state.posterior.weight)


def to_returns(state: LogOddsFit) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the start value and the slope of R = start_value + slope w . x.

    They are those of a regression of the episodes' expected returns, which have no noise.
    """
    valid, _, _ = _valid_range(state)
    n_episodes = jnp.maximum(jnp.sum(valid), 1)
    log_odds = jnp.where(valid, state.posterior.bias + state.columns @ state.posterior.weight, 0)
    expected = jnp.where(valid, predict(state, state.columns), 0)
    mean, expected_mean = jnp.sum(log_odds) / n_episodes, jnp.sum(expected) / n_episodes
    difference = jnp.where(valid, log_odds - mean, 0)
    variance = jnp.sum(difference**2)
    slope = jnp.where(variance > 0, difference @ (expected - expected_mean) / jnp.where(variance > 0, variance, 1), 0)
    return expected_mean + slope * (state.posterior.bias - mean), slope


def from_linear(state: LogOddsFit, linear: Float[Array, " episodes"]) -> Float[Array, " episodes"]:
    """Return the expected returns of episodes by their linear predictions start_value + slope w . x (see `to_returns`)."""
    (start_value, slope), (_, low, high) = to_returns(state), _valid_range(state)
    log_odds = state.posterior.bias + (linear - start_value) / jnp.where(slope == 0, 1, slope)
    return jnp.where(slope == 0, linear, low + (high - low) * jax.nn.sigmoid(log_odds))


def covariance(state: LogOddsFit) -> PosteriorCovariance:
    """Return the covariance of what steps are paid, in the unit of the return."""
    _, slope = to_returns(state)
    return PosteriorCovariance(slope * state.root, jnp.zeros(len(state.root)), jnp.zeros(()))
