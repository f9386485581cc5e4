"""The equations of return decomposition by gradient descent.

Each loss maps a decoder's outputs for some episodes to one number, which is minimised. Notation: r_hat is the proxy reward of
a step, T the length of an episode, R its return, K the number of its sampled steps. Only `step_loss` returns a number for each episode.

The target is R/T, as in LaRe's published code. With `sum_form`, each squared error has the weight T^2, so it is (sum_t r_hat_t - R)^2
(Eq. 6 of the LaRe paper): longer episodes weigh more. If all episodes have the same length, the two losses differ by a factor alone.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lare_rl.nn.masks import masked_mean, step_mask
from lare_rl.nn.networks import MLP

__all__ = [
    "EpisodeInputs",
    "EpisodeLengths",
    "PerEpisode",
    "episode_means",
    "episode_weight",
    "leave_one_out_nll",
    "mean_over_episodes",
    "squared_error",
    "step_loss",
    "subsampling_variance",
    "unbiased_squared_error",
]

PerEpisode = Float[Array, " episodes"]
EpisodeInputs = Float[Array, "episodes steps inputs"]
EpisodeLengths = Int[Array, " episodes"]


def mean_over_episodes(weighted: PerEpisode, weight: PerEpisode) -> Float[Array, ""]:
    """Return the mean of weighted values over the episodes whose weight is above 0."""
    return masked_mean(weighted, weight > 0)


def episode_means(
    r_hat: Float[Array, " steps"], episode_index: Int[Array, " steps"], n_steps: Int[Array, " episodes"]
) -> PerEpisode:
    """Return mean_t r_hat_t of each episode over its steps in the batch: all T of them, or K sampled ones.

    `n_steps` is the number of steps of each episode in the batch. Rows with the index of no episode are padding, and are ignored. No index
    is negative.
    """
    total = jnp.zeros(n_steps.shape, r_hat.dtype).at[episode_index].add(r_hat, mode="drop")
    return total / jnp.maximum(n_steps, 1)


def squared_error(mean: PerEpisode, target: PerEpisode, weight: PerEpisode) -> Float[Array, ""]:
    """Return the mean of w_b (mean_b - target_b)^2 over the episodes whose weight is not zero.

    With `mean` over all T steps and `target` = R/T, this is the loss of RD (Efroni et al., 2021): with weight 1 as in LaRe's code,
    with weight T^2 as in LaRe's Eq. 6. With `mean` over K sampled steps, it is the loss of RRD (Ren et al., 2022, Eq. 6).
    `episode_weight` computes `weight`.
    """
    return mean_over_episodes(weight * (mean - target) ** 2, weight)


def subsampling_variance(r_hat: Float[Array, "episodes K"], length: Int[Array, " episodes"]) -> PerEpisode:
    """Return Var_K(r_hat) (1 - K/T) / K, which sampling K of T steps adds to the squared error (Ren et al., 2022, Appendix).

    Var_K is the sample variance (divided by K - 1). The finite-population factor (1 - K/T) is due to sampling without replacement.
    If K >= T, all T steps are used and the value is 0. It is never negative. K = 1 has no sample variance: the value is 0, and the loss
    is that of RRD.
    """
    k = r_hat.shape[1]
    fraction = jnp.maximum(1 - k / jnp.maximum(length, 1), 0)
    return jnp.var(r_hat, axis=1, ddof=min(1, k - 1)) * fraction / k


def unbiased_squared_error(
    mean: PerEpisode, target: PerEpisode, weight: PerEpisode, variance: PerEpisode
) -> Float[Array, ""]:
    """Return the loss of RRD-unbiased: RRD's loss minus the `subsampling_variance`. Its expectation is RD's loss."""
    return squared_error(mean, target, weight) - mean_over_episodes(weight * variance, weight)


def leave_one_out_nll(
    mean: PerEpisode, target: PerEpisode, weight: PerEpisode, precision: PerEpisode, log_std: PerEpisode
) -> Float[Array, ""]:
    """Return the negative log likelihood of LRR without its constant: the mean over episodes of [w_b (mean_b - target_b)^2 p_b / 2] + l_b.

    p_b = mean_t 1/sigma_t^2 and l_b = mean_t log sigma_t, over the steps of episode b. Each step is judged by what R leaves when the means
    of all other steps are subtracted (`lrr.py`).
    """
    loss = weight * (mean - target) ** 2 * precision / 2 + jnp.where(weight > 0, log_std, 0)
    return mean_over_episodes(loss, weight)


def episode_weight(length: Int[Array, " episodes"], mask: PerEpisode, sum_form: bool) -> PerEpisode:
    """Return the weight of each episode: 1 if R/T is fitted, T^2 if the sum R is fitted (`sum_form`), 0 where `mask` is 0."""
    return mask * length.astype(jnp.float32) ** 2 if sum_form else mask


def step_loss(
    step_model: MLP, inputs: EpisodeInputs, prefix_returns: Float[Array, "episodes steps"], length: EpisodeLengths
) -> Float[Array, " episodes"]:
    """Return the mean squared error of a step model over the steps of each episode, for Diaster, RUDDER and RBT.

    An algorithm that samples transitions needs rewards of single stored steps, which a model of whole episodes cannot give. From the
    inputs of a step alone, the step model predicts the difference of F at that step, averaged over all episodes with such a step:

        (r_hat(x_t) - L (F_t - F_{t-1}))^2,    F_{-1} = 0

    `prefix_returns` is F_t, the sum of the rewards of the steps 0 to t by the model of episodes, divided by L times the scale; no
    gradient goes to it. L is the number of rows of an episode with its padding: the steps of the longest episode, which the assigner
    rounds up to a power of two. The scale is that of `decoder_state.reward_unit`. The step model predicts the reward divided by the scale.
    """
    n_rows = inputs.shape[1]
    target = n_rows * jnp.diff(jax.lax.stop_gradient(prefix_returns), axis=1, prepend=0)
    squared_error = (step_model(inputs)[..., 0] - target) ** 2
    return jnp.sum(step_mask(length, n_rows) * squared_error, axis=1) / jnp.maximum(length, 1)
