"""STAS: spatial-temporal return decomposition (Chen et al., AAAI 2024), its first and default version.

Causal attention over the steps of each agent is followed by attention over the agents of each step, under random coalitions.
The mean over the coalitions approximates the Shapley value of an agent:

    r_hat_{i,t} = w . mean_k attention(h_t, mask_k)_i,    mask_k ~ Bernoulli(1/2)^{n x n}, 1 on the diagonal

During learning, each part of a batch has its own draws of coalitions, agent numbers and dropout. The published code also draws
when it computes rewards. Here a reward is the mean over `USED` draws, the same at every call.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoders import Decoded
from lare_rl.nn.attention import LayerNorm, attend, causal
from lare_rl.nn.networks import MLP, Linear

SIZE, HEADS, LAYERS, COALITIONS = 128, 4, 3, 5

USED = 8
"""The policy's reward is the mean over this many draws of coalitions and agent numbers."""


def dropout(x: Float[Array, "..."], key: PRNGKeyArray | None) -> Float[Array, "..."]:
    """Set half of the entries, chosen at random, to 0 and double the others. Without a key, return x."""
    if key is None:
        return x
    # One random bit per entry: a random number per entry would take a fifth of the time of STAS.
    coins = jnp.unpackbits(jax.random.bits(key, (-(-x.size // 8),), jnp.uint8))
    return 2 * x * coins[: x.size].reshape(x.shape)


def gelu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The exact GELU: x times the probability that a standard normal variable is below x (Hendrycks and Gimpel, 2016)."""
    return jax.nn.gelu(x, approximate=False)


def heads(x: Float[Array, "*batch size"]) -> Float[Array, "*batch heads part"]:
    return x.reshape(*x.shape[:-1], HEADS, SIZE // HEADS)


class TimeLayer(eqx.Module):
    """a = attention(x), out = LN(FF(LN(x + a)) + 2 a): as published, x itself is not added again."""

    query: Linear
    key: Linear
    value: Linear
    merge: Linear
    feed_forward: MLP
    norms: tuple[LayerNorm, LayerNorm]

    def __init__(self, *, key: PRNGKeyArray):
        *keys, last = jax.random.split(key, 5)
        self.query, self.key, self.value, self.merge = (Linear(SIZE, SIZE, key=key) for key in keys)
        self.feed_forward = MLP(SIZE, (SIZE,), SIZE, key=last, activation=gelu)
        self.norms = LayerNorm(SIZE, 1e-12), LayerNorm(SIZE, 1e-12)

    def __call__(
        self, x: Float[Array, "*batch steps size"], key: PRNGKeyArray | None
    ) -> Float[Array, "*batch steps size"]:
        keys = (None,) * 3 if key is None else jax.random.split(key, 3)
        query, keys_of_x, value = (heads(part(x)) for part in (self.query, self.key, self.value))
        found = attend(query, keys_of_x, value, causal(x.shape[-2]), partial(dropout, key=keys[0]))
        a = dropout(self.merge(found), keys[1])
        hidden = self.norms[0](x + a)
        return self.norms[1](dropout(self.feed_forward(hidden), keys[2]) + 2 * a)


class Coalitions(eqx.Module):
    """Attention over agents, averaged over random coalitions. Each agent has its own projection to queries."""

    query: Linear
    """One layer for each agent, stacked."""
    key: Linear
    value: Linear
    merge: Linear

    def __init__(self, agents: int, *, key: PRNGKeyArray):
        query_key, *keys = jax.random.split(key, 4)
        self.query = eqx.filter_vmap(lambda key: Linear(SIZE, SIZE, key=key))(jax.random.split(query_key, agents))
        self.key, self.value, self.merge = (Linear(SIZE, SIZE, key=key) for key in keys)

    def __call__(
        self, x: Float[Array, "*batch agents size"], key: PRNGKeyArray, drop: PRNGKeyArray | None
    ) -> Float[Array, "*batch agents size"]:
        agents = x.shape[-2]
        drops = (None,) * 2 if drop is None else jax.random.split(drop)
        query = heads(jnp.einsum("...ad,ade->...ae", x, self.query.weight) + self.query.bias)
        joined = jax.random.bernoulli(key, 0.5, (COALITIONS, agents, agents)) | jnp.eye(agents, dtype=bool)
        # Each agent needs one query for every coalition.
        found = attend(
            jnp.tile(query, (COALITIONS, 1, 1)),
            heads(self.key(x)),
            heads(self.value(x)),
            joined.reshape(-1, agents),
            partial(dropout, key=drops[0]),
        )
        merged = dropout(self.merge(found), drops[1])
        return jnp.mean(merged.reshape(*x.shape[:-2], COALITIONS, agents, SIZE), axis=-3)


class STAS(eqx.Module):
    """The published network, layer by layer."""

    embed: Linear
    """Embeds the observation and the one-hot action."""
    step: Float[Array, "steps size"]
    number: Float[Array, "agents size"]
    """Embeddings of agent numbers, which are assigned at random."""
    layers: tuple[TimeLayer, ...]
    coalitions: Coalitions
    last: Linear
    gain: float = eqx.field(static=True)

    def __init__(self, features: int, steps: int, agents: int, gain: float, *, key: PRNGKeyArray):
        self.gain = gain
        embed_key, step_key, number_key, layers_key, coalitions_key, last_key = jax.random.split(key, 6)
        self.embed = Linear(features, SIZE, key=embed_key)
        self.step = jax.random.normal(step_key, (steps, SIZE))
        self.number = jax.random.normal(number_key, (agents, SIZE))
        self.layers = tuple(TimeLayer(key=key) for key in jax.random.split(layers_key, LAYERS))
        self.coalitions = Coalitions(agents, key=coalitions_key)
        self.last = Linear(SIZE, 1, key=last_key)

    def __call__(self, features: Float[Array, "rows agents features"], key: PRNGKeyArray | None) -> Decoded:
        rows, agents = features.shape[:2]
        x = self.embed(features).reshape(-1, len(self.step), agents, SIZE)
        x = jnp.swapaxes(x, 1, 2) + self.step
        drawn_key, drop, *keys = [None] * (2 + LAYERS) if key is None else jax.random.split(key, 2 + LAYERS)
        for layer, layer_key in zip(self.layers, keys, strict=True):
            x = layer(x, layer_key)
        x = jnp.swapaxes(x, 1, 2)
        if drawn_key is not None:
            r_hat = self.among_agents(x, drawn_key, drop)
        else:
            draws = jax.lax.map(lambda one: self.among_agents(x, one, None), jax.random.split(jax.random.key(0), USED))
            r_hat = jnp.mean(draws, axis=0)
        return Decoded(r_hat.reshape(rows, agents), jnp.zeros((rows, agents)))

    def among_agents(
        self, x: Float[Array, "episodes steps agents size"], key: PRNGKeyArray, drop: PRNGKeyArray | None
    ) -> Float[Array, "episodes steps agents"]:
        """The agents' rewards for one draw of coalitions and of agent numbers."""
        coalitions_key, order_key = jax.random.split(key)
        order = jax.random.permutation(order_key, len(self.number))
        return self.gain * self.last(self.coalitions(x + self.number[order], coalitions_key, drop))[..., 0]
