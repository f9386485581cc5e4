"""Attention over an axis, and layer normalisation."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

__all__ = ["LayerNorm", "attend", "causal_mask"]


class LayerNorm(eqx.Module):
    """(x - mean) / std of each row, then scaled and shifted (Ba, Kiros and Hinton, 2016)."""

    weight: Float[Array, " size"]
    bias: Float[Array, " size"]
    epsilon: float = eqx.field(static=True)

    def __init__(self, size: int, epsilon: float = 1e-5):
        self.weight, self.bias, self.epsilon = jnp.ones(size), jnp.zeros(size), epsilon

    def __call__(self, x: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.mean(centred**2, axis=-1, keepdims=True)
        return self.weight * centred * jax.lax.rsqrt(variance + self.epsilon) + self.bias


def attend(
    query: Float[Array, "*batch queries heads size"],
    key: Float[Array, "*batch tokens heads size"],
    value: Float[Array, "*batch tokens heads size"],
    mask: Bool[Array, "*masks queries tokens"] | None = None,
    transform: Callable[[Array], Array] = lambda weights: weights,
) -> Float[Array, "*batch outputs concatenated"]:
    """Return softmax(Q K^T / sqrt(size)) V of each head, concatenated over heads (Vaswani et al., 2017, Eq. 1).

    Args:
        mask: which tokens each query attends to. With several masks, each query has an output for each of them, mask by mask.
        transform: a function of the attention weights, [rows, *masks, queries, tokens]: dropout, or a mean over masks.
    """
    *batch, _, heads, size = query.shape

    def by_head(x: Float[Array, "*batch tokens heads size"]) -> Float[Array, "rows tokens size"]:
        # Batch axes and heads become one axis, because XLA is fastest at products of arrays with three axes.
        return jnp.swapaxes(x, -2, -3).reshape(-1, x.shape[-3], size)

    scores = jax.lax.batch_matmul(by_head(query), jnp.swapaxes(by_head(key), 1, 2)) / jnp.sqrt(size)
    if mask is not None:
        scores = jnp.where(mask, jnp.expand_dims(scores, range(1, mask.ndim - 1)), -1e9)
    weights = transform(jax.nn.softmax(scores))
    output = jax.lax.batch_matmul(weights.reshape(len(scores), -1, weights.shape[-1]), by_head(value))
    by_query = jnp.swapaxes(output.reshape(*batch, heads, -1, size), -2, -3)
    return by_query.reshape(*by_query.shape[:-2], heads * size)


def causal_mask(length: int) -> Bool[Array, "length length"]:
    """Return a mask by which each step attends to itself and to earlier steps."""
    return jnp.tril(jnp.ones((length, length), bool))
