"""Accuracy of proxy rewards against the true rewards. Only for measurement: nothing is trained on it."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def metrics(
    r_hat: Float[Array, " steps"],
    reward: Float[Array, " steps"],
    last: Bool[Array, " steps"],
    mask: Bool[Array, " steps"],
    in_reward_units: bool,
) -> dict[str, Float[Array, ""]]:
    """The accuracy, under the keys of metrics.jsonl.

    The error is included only if proxy rewards are in the unit of the true rewards (`in_reward_units`). All values are NaN if only
    the last steps of episodes have paid a reward: the true rewards of single steps are then unknown.
    """
    known = jnp.any((reward != 0) & mask & ~last)
    found = {"credit/correlation": correlation(r_hat, reward, mask)}
    found |= {"credit/error": mean_error(r_hat, reward, mask)} if in_reward_units else {}
    return {name: jnp.where(known, value, jnp.nan) for name, value in found.items()}


def mean_error(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Mean |r_hat - r| over the steps where `mask` is true (the paper's Table F.5)."""
    return jnp.sum(jnp.abs(r_hat - reward) * mask) / jnp.maximum(jnp.sum(mask), 1)


def correlation(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Pearson's correlation of r_hat with r over the steps where `mask` is true; NaN where one of them never varies."""
    total = jnp.maximum(jnp.sum(mask), 1)

    def centred(x: Float[Array, " steps"]) -> Float[Array, " steps"]:
        return (x - jnp.sum(x * mask) / total) * mask

    a, b = centred(r_hat), centred(reward)
    return jnp.clip(jnp.sum(a * b) / jnp.sqrt(jnp.sum(a**2) * jnp.sum(b**2)), -1, 1)  # rounding can exceed 1
