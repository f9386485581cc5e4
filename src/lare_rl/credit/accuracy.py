"""The accuracy of proxy rewards against the true rewards. It is only measured: nothing is trained on it."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lare_rl.nn.masks import masked_mean

__all__ = ["masked_correlation", "mean_absolute_error", "metrics"]


def metrics(
    r_hat: Float[Array, " steps"],
    reward: Float[Array, " steps"],
    last: Bool[Array, " steps"],
    mask: Bool[Array, " steps"],
    calibrated: bool,
) -> dict[str, Float[Array, ""]]:
    """Return the accuracy over the steps where `mask` is true, under the keys of metrics.jsonl.

    All values are NaN if only the last steps of episodes (`last`) have a reward, because the true rewards of single steps are then
    unknown. The error is left out unless proxy rewards are in the unit of the true rewards (`calibrated`).
    """
    has_step_rewards = jnp.any((reward != 0) & mask & ~last)
    values = {"credit/correlation": masked_correlation(r_hat, reward, mask)}
    if calibrated:
        values["credit/error"] = mean_absolute_error(r_hat, reward, mask)
    return {name: jnp.where(has_step_rewards, value, jnp.nan) for name, value in values.items()}


def mean_absolute_error(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Return the mean of |r_hat - r| over the steps where `mask` is true (the paper's Table F.5)."""
    return masked_mean(jnp.abs(r_hat - reward), mask)


def masked_correlation(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Return Pearson's correlation over the steps where `mask` is true, or NaN where one of the two never varies."""
    x, y = ((values - masked_mean(values, mask)) * mask for values in (r_hat, reward))
    return jnp.clip(jnp.sum(x * y) / jnp.sqrt(jnp.sum(x**2) * jnp.sum(y**2)), -1, 1)  # rounding can exceed 1
