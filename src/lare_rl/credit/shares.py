"""Shares of the return: the deterministic normalisation of TAR2 (Kapoor et al., 2025, arXiv 2502.04864).

A decoder gives contributions c_{i,t}. Those of a step, and those of the agents of a step, become weights that add up to 1:

    w_t     = (C_t - min C) / sum_u (C_u - min C),              C_t = sum_i c_{i,t}
    w_{i,t} = (c_{i,t} - min_j c_{j,t}) / sum_j (c_{j,t} - min_k c_{k,t})

The share of agent i at step t is w_t w_{i,t}. The shares of an episode add up to 1 whatever the contributions are, so that the rewards
share * R add up to the return. If all contributions of a sum are equal, their weights are equal, too: the authors' code pays nothing
then, and adds 1e-5 to each denominator.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

__all__ = ["return_shares"]


def return_shares(
    contributions: Float[Array, "episodes steps agents"], alive: Bool[Array, "episodes steps agents"]
) -> Float[Array, "episodes steps agents"]:
    """Return the share of each agent at each step. Only agents that are alive have one."""
    step_contribution = jnp.sum(jnp.where(alive, contributions, 0), axis=-1)
    step_weight = _weights(step_contribution, jnp.any(alive, axis=-1))
    return step_weight[..., None] * _weights(contributions, alive)


def _weights(values: Float[Array, "*batch size"], mask: Bool[Array, "*batch size"]) -> Float[Array, "*batch size"]:
    """Return weights over the last axis that add up to 1: how much each value exceeds the least one. 0 where `mask` is false."""
    lowest = jnp.min(jnp.where(mask, values, jnp.inf), axis=-1, keepdims=True)
    excess = jnp.where(mask, values - lowest, 0)
    total = jnp.sum(excess, axis=-1, keepdims=True)
    equal = mask / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1)
    return jnp.where(total > 0, excess / jnp.where(total > 0, total, 1), equal)
