"""The equations of return decomposition.

Each loss maps a decoder's outputs for some episodes to one number, which is minimised. Notation: r_hat is the proxy reward of
a step, T the length of an episode, R its return, K the number of steps drawn from it, B the number of episodes in a batch.

The published code fits R/T, the mean reward of a step, rather than R (Eq. 6 of the LaRe paper). R/T is far better conditioned,
and has the same minimiser if all episodes have the same length. `sum_form` fits R.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def episode_means(
    r_hat: Float[Array, " steps"], episode: Int[Array, " steps"], steps: Int[Array, " episodes"]
) -> Float[Array, " episodes"]:
    """mean_t r_hat_t of each episode over its given steps: all T, or K drawn ones.

    `episode` is the index of each step's episode; a step whose index is outside 0..B-1 is ignored. `steps` is the number of
    given steps of each episode.
    """
    total = jnp.zeros(steps.shape, r_hat.dtype).at[episode].add(r_hat, mode="drop")
    return total / jnp.maximum(steps, 1)


def squared_error(
    mean: Float[Array, " episodes"], target: Float[Array, " episodes"], weight: Float[Array, " episodes"]
) -> Float[Array, ""]:
    """sum_b w_b (mean_b - target_b)^2 / B, over the B episodes whose weight is not zero.

    With `mean` over all T steps and `target` = R/T this is the loss of RD (Efroni et al., 2021; LaRe, Eq. 6); with
    `mean` over K drawn steps it is that of RRD (Ren et al., 2022, Eq. 6). `weight` is 1 for an episode that counts,
    T^2 for the sum form, 0 for an empty place.
    """
    return jnp.sum(weight * (mean - target) ** 2) / jnp.maximum(jnp.sum(weight > 0), 1)


def subsampling_variance(
    r_hat: Float[Array, "episodes K"], length: Int[Array, " episodes"]
) -> Float[Array, " episodes"]:
    """Var(mean of K) = Var_K(r_hat) * (1 - K/T) / K: what drawing K of T steps adds to the squared error.

    `Var_K` is the sample variance (divided by K - 1), and the finite-population factor (1 - K/T) holds for drawing
    without replacement. RRD-unbiased subtracts it (Ren et al., 2022, Appendix). If K >= T, all T steps are used and
    the value is 0; it is never negative.
    """
    drawn = r_hat.shape[1]
    fraction = jnp.maximum(1 - drawn / jnp.maximum(length, 1), 0)
    return jnp.var(r_hat, axis=1, ddof=min(1, drawn - 1)) * fraction / drawn


def unbiased_squared_error(
    mean: Float[Array, " episodes"],
    target: Float[Array, " episodes"],
    weight: Float[Array, " episodes"],
    variance: Float[Array, " episodes"],
) -> Float[Array, ""]:
    """RRD-unbiased: the loss of RRD minus the `subsampling_variance`, so that its expectation is RD's loss."""
    correction = jnp.sum(weight * variance) / jnp.maximum(jnp.sum(weight > 0), 1)
    return squared_error(mean, target, weight) - correction


def episode_weight(
    length: Int[Array, " episodes"], mask: Float[Array, " episodes"], sum_form: bool
) -> Float[Array, " episodes"]:
    """The weight of an episode: 1 if R/T is fitted, T^2 if the sum R is fitted (`sum_form`); 0 where `mask` is 0."""
    return mask * length.astype(jnp.float32) ** 2 if sum_form else mask
