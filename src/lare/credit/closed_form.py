"""Decoders that are linear in the factors, fitted to returns in closed form from running statistics of whole episodes.

    r_hat = w . z + b

With z_k the mean of the factors over the steps of episode k, and R_k/T its mean reward:

    ridge    w = argmin sum_k (R_k/T - w . z_k - b)^2 + lambda |S w|^2    (LaRe, appendix B, the estimator of Proposition 1)
    signs    w = argmin sum_k (R_k/T - w . z_k)^2  over  w in {-1, 1}^d,  b = 0    (LaRe without the reward model)

S holds the deviations of the z_k, so that the scale of a factor changes nothing. Nothing here descends a gradient: what has
been learned after k episodes is exact, and costs the same for each new episode.

The estimator comes with a confidence radius, after Proposition 1. With x_k = (1, S^-1 (z_k - their mean)) in d + 1 entries and
A = sum_k x_k x_k^T + lambda diag(0, 1, ..., 1),

    l_k = sigma sqrt((d + 1) log((1 + k L^2 / lambda) / (delta / 10))) + B sqrt(lambda d),    |r - r_hat| <= l_k |x|_{A^-1}

(L the largest |x_k|; sum_k |x_k|^2, which is no more, stands for k L^2; B the largest |R/T|). The proposition knows that the
reward of a step lies between 0 and 1, so that the noise of R/T deviates by 1/(2 sqrt(T)) at most; nobody knows that here, and
sigma is the deviation of the residuals. So the band is the proposition's by analogy: to be expected where rewards are linear in
the factors, w x + b with |w| <= B sqrt(d), and no theorem. Nearly equal factors whose large weights cancel break it.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare.credit.decoders import Decoded

LARGEST_CHOICE = 16
"""Factors whose signs are searched through, all 2^d of them."""


class LinearDecoder(eqx.Module):
    """r_hat = w . z + b, on the factors as they are."""

    weight: Float[Array, " features"]
    bias: Float[Array, ""]

    def __call__(self, features: Float[Array, "rows *agents features"], key: PRNGKeyArray | None) -> Decoded:
        return Decoded(features @ self.weight + self.bias, jnp.zeros(features.shape[:-1]))


class Totals(NamedTuple):
    """Running statistics of v_k = (z_k, R_k/T) over episodes, and of those that are under way."""

    episodes: Float[Array, ""]
    mean: Float[Array, " features_and_reward"]
    products: Float[Array, "features_and_reward features_and_reward"]
    """sum_k (v_k - mean)(v_k - mean)^T"""
    farthest: Float[Array, ""]
    """The largest |R/T|."""
    running: Float[Array, "envs features"]
    """Mean of the factors since the episode began: of a constant it is that constant, however long the episode is."""
    steps: Float[Array, " envs"]
    """Steps since then."""


def new_totals(features: int, envs: int = 1) -> Totals:
    """The totals of no episodes."""
    zero, size = jnp.zeros(()), features + 1
    running = jnp.zeros((envs, features)), jnp.zeros(envs)
    return Totals(zero, jnp.zeros(size), jnp.zeros((size, size)), jnp.copy(zero), *running)


def add_steps(
    totals: Totals,
    features: Float[Array, "time envs features"],
    mean_reward: Float[Array, "time envs"],
    ended: Bool[Array, "time envs"],
) -> Totals:
    """Add steps that follow each other in each environment; `mean_reward` is R/T where an episode has `ended`.

    The products grow by Welford's update (1962): no catastrophic cancellation.
    """

    def one(totals: Totals, step: tuple[Float[Array, "envs features"], Float[Array, " envs"], Bool[Array, " envs"]]):
        rows, reward, last = step
        steps = totals.steps + 1
        running = totals.running + (rows - totals.running) / steps[:, None]

        def with_episode(place: Array, totals: Totals) -> Totals:
            longer = add_episode(totals, jnp.append(running[place], reward[place]))
            return jax.tree.map(lambda new, old: jnp.where(last[place], new, old), longer, totals)

        totals = jax.lax.fori_loop(0, len(last), with_episode, totals)
        return totals._replace(running=jnp.where(last[:, None], 0, running), steps=jnp.where(last, 0, steps)), None

    return jax.lax.scan(one, totals, (features, mean_reward, ended))[0]


def add_episode(totals: Totals, v: Float[Array, " features_and_reward"]) -> Totals:
    """With one more episode."""
    count, gap = totals.episodes + 1, v - totals.mean
    mean = totals.mean + gap / count
    products = totals.products + jnp.outer(gap, v - mean)
    return totals._replace(
        episodes=count, mean=mean, products=products, farthest=jnp.maximum(totals.farthest, jnp.abs(v[-1]))
    )


def forget_running(totals: Totals, dropped: Bool[Array, " envs"]) -> Totals:
    """Without the episodes that are under way in some of the environments."""
    return totals._replace(
        running=jnp.where(dropped[:, None], 0, totals.running), steps=jnp.where(dropped, 0, totals.steps)
    )


def deviations(totals: Totals) -> Float[Array, " features"]:
    """S: the deviations of the episodes' mean factors; 1 for one that never varied."""
    of_each = jnp.sqrt(jnp.diagonal(totals.products)[:-1] / jnp.maximum(totals.episodes, 1))
    return jnp.where(of_each > 1e-6 * jnp.abs(totals.mean[:-1]), of_each, 1)


def design_matrix(totals: Totals, ridge: float) -> Float[Array, "features features"]:
    """A."""
    unit = deviations(totals)
    return totals.products[:-1, :-1] / jnp.outer(unit, unit) + ridge * jnp.eye(len(unit))


def ridge_regression(totals: Totals, ridge: float) -> LinearDecoder:
    """The regularised least-squares estimate of the rewards."""
    unit, mean = deviations(totals), totals.mean
    weight = jnp.linalg.solve(design_matrix(totals, ridge), totals.products[:-1, -1] / unit) / unit
    return LinearDecoder(weight, mean[-1] - weight @ mean[:-1])


def best_signs(totals: Totals) -> LinearDecoder:
    """The signs for which the sum of the factors comes nearest to the returns; the first of them where some are equal."""
    count, mean = totals.episodes, totals.mean
    signs = jnp.asarray(np.array(list(itertools.product((1.0, -1.0), repeat=len(mean) - 1)), np.float32))
    # Of v = (z, R/T) times (w, -1): the sum of the squares is that about the mean and k times that of the mean.
    v = jnp.concatenate([signs, -jnp.ones((len(signs), 1))], axis=1)
    error = jnp.sum((v @ totals.products) * v, axis=1) + count * (v @ mean) ** 2
    return LinearDecoder(signs[jnp.argmin(error)], jnp.zeros(()))


def uncertainty(
    totals: Totals, features: Float[Array, "rows features"], ridge: float, delta: float
) -> Float[Array, " rows"]:
    """l_k |x|_{A^-1}: how far r_hat may be from the true reward of each row, in the rewards' units."""
    x = (features - totals.mean[:-1]) / deviations(totals)
    inverse = jnp.linalg.inv(design_matrix(totals, ridge))
    length = 1 / jnp.maximum(totals.episodes, 1) + jnp.sum((x @ inverse) * x, axis=1)
    return radius(totals, ridge, delta) * jnp.sqrt(length)


def radius(totals: Totals, ridge: float, delta: float) -> Float[Array, ""]:
    """l_k, in the rewards' units."""
    size = len(totals.mean) - 1
    squares = totals.episodes + jnp.trace(design_matrix(totals, 0.0))
    grown = jnp.log((1 + squares / ridge) / (delta / 10))
    return noise(totals, ridge) * jnp.sqrt((size + 1) * grown) + totals.farthest * jnp.sqrt(ridge * size)


def noise(totals: Totals, ridge: float) -> Float[Array, ""]:
    """The deviation of the residuals R_k/T - r_hat(z_k); the largest |R/T| as long as there are no more episodes than weights."""
    v = jnp.append(ridge_regression(totals, ridge).weight, -1.0)
    free = totals.episodes - len(v)
    left = jnp.maximum(v @ totals.products @ v, 0)
    return jnp.where(free > 0, jnp.sqrt(left / jnp.maximum(free, 1)), totals.farthest)
