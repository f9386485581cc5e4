"""STAS: spatial-temporal return decomposition (Chen et al., AAAI 2024), after version "v1" of the authors' code, its default.

Causal attention over the steps of each agent is followed by attention over the agents of each step, under random coalitions.
The mean over the coalitions approximates the Shapley value of an agent:

    r_hat_{i,t} = w . mean_k attention(h_t, mask_k)_i,    mask_k ~ Bernoulli(1/2)^{n x n}, 1 on the diagonal

h_t are the outputs of the attention over steps, one row for each agent, and k = 1..`COALITIONS`. w includes a bias, and the result is
multiplied by `CreditSpec.output_scale`. During learning, each batch (or chunk of a large one) has its own samples of coalitions, of the
order of agents' index embeddings, and of dropout. A reward is the mean over `REWARD_SAMPLES` samples,
which are the same at each call.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput, split_key
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.attention import LayerNorm, attend, causal_mask
from lare_rl.nn.dropout import dropout
from lare_rl.nn.networks import MLP, Linear

__all__ = ["STAS", "Coalitions", "TimeLayer", "gelu", "mean_over_samples"]

SIZE, HEADS, LAYERS, COALITIONS = 128, 4, 3, 5
"""The width of a token, the number of heads, of layers over time, and of sampled coalitions."""
REWARD_SAMPLES = 8
DROPOUT = 0.5
"""The probability that an activation is dropped in an update."""


def gelu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the exact GELU (Hendrycks and Gimpel, 2016)."""
    return jax.nn.gelu(x, approximate=False)


def mean_over_samples(function: Callable[[PRNGKeyArray], Float[Array, "*shape"]]) -> Float[Array, "*shape"]:
    """Return the mean of a function of a random key over `REWARD_SAMPLES` keys, which are the same at each call."""
    keys = jax.random.split(jax.random.key(jnp.uint32(0)), REWARD_SAMPLES)
    return jnp.mean(jax.lax.map(function, keys), axis=0)


def _split_heads(x: Float[Array, "*batch size"]) -> Float[Array, "*batch heads head_size"]:
    return x.reshape(*x.shape[:-1], HEADS, x.shape[-1] // HEADS)


class TimeLayer(eqx.Module):
    """a = attention(x), out = LN(FF(LN(x + a)) + 2 a). As published, x itself is not added again. The size is a multiple of `HEADS`."""

    query: Linear
    key: Linear
    value: Linear
    merge: Linear
    feed_forward: MLP
    norms: tuple[LayerNorm, LayerNorm]

    def __init__(self, size: int = SIZE, *, key: PRNGKeyArray):
        *keys, last_key = jax.random.split(key, 5)
        self.query, self.key, self.value, self.merge = (Linear(size, size, key=key) for key in keys)
        self.feed_forward = MLP(size, (size,), size, key=last_key, activation=gelu)
        self.norms = LayerNorm(size, 1e-12), LayerNorm(size, 1e-12)

    def __call__(
        self, x: Float[Array, "*batch steps size"], key: PRNGKeyArray | None
    ) -> Float[Array, "*batch steps size"]:
        dropout_keys = split_key(key, 3)
        query, projected_key, value = (_split_heads(layer(x)) for layer in (self.query, self.key, self.value))
        attention = attend(
            query, projected_key, value, causal_mask(x.shape[-2]), partial(dropout, key=dropout_keys[0], rate=DROPOUT)
        )
        a = dropout(self.merge(attention), dropout_keys[1], DROPOUT)
        hidden = self.norms[0](x + a)
        return self.norms[1](dropout(self.feed_forward(hidden), dropout_keys[2], DROPOUT) + 2 * a)


class Coalitions(eqx.Module):
    """Attention over agents, averaged over random coalitions. Each agent has its own projection to queries.

    An index embedding is added to each agent: which one is random, and the same at all steps of a call. The size is a multiple of
    `HEADS`.
    """

    query: Linear
    """The layers of all agents, stacked."""
    key: Linear
    value: Linear
    merge: Linear

    def __init__(self, agents: int, size: int = SIZE, *, key: PRNGKeyArray):
        query_key, *keys = jax.random.split(key, 4)
        self.query = eqx.filter_vmap(lambda key: Linear(size, size, key=key))(jax.random.split(query_key, agents))
        self.key, self.value, self.merge = (Linear(size, size, key=key) for key in keys)

    def __call__(
        self,
        x: Float[Array, "*batch agents size"],
        index_embeddings: Float[Array, "agents size"],
        key: PRNGKeyArray,
        dropout_key: PRNGKeyArray | None,
    ) -> Float[Array, "*batch agents size"]:
        """Return the mean over `COALITIONS` random masks, with one random order of the index embeddings."""
        agents = len(index_embeddings)
        mask_key, order_key = jax.random.split(key)
        x = x + index_embeddings[jax.random.permutation(order_key, agents)]
        dropout_keys = split_key(dropout_key, 2)
        query = _split_heads(jnp.einsum("...ad,ade->...ae", x, self.query.weight) + self.query.bias)
        # Returns are predicted with float64 on. A probability in float32 gives them the same draws as rewards have.
        coins = jax.random.bernoulli(mask_key, jnp.float32(0.5), (COALITIONS, agents, agents))
        mask = coins | jnp.eye(agents, dtype=bool)

        def transform(
            weights: Float[Array, "rows masks queries agents"],
        ) -> Float[Array, "rows outputs queries agents"]:
            if dropout_key is not None:
                return dropout(weights, dropout_keys[0], DROPOUT)
            # Without dropout, what follows is linear: the mean over coalitions costs least here.
            return jnp.mean(weights, axis=1, keepdims=True)

        attention = attend(query, _split_heads(self.key(x)), _split_heads(self.value(x)), mask, transform)
        merged = dropout(self.merge(attention), dropout_keys[1], DROPOUT)
        return jnp.mean(merged.reshape(*x.shape[:-2], -1, *x.shape[-2:]), axis=-3)


class STAS(eqx.Module):
    """The published network, layer by layer."""

    embed: Linear
    """Embeds the observation and the one-hot action."""
    position: Float[Array, "steps size"]
    index_embeddings: Float[Array, "agents size"]
    layers: tuple[TimeLayer, ...]
    coalitions: Coalitions
    head: Linear
    output_scale: float = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        self.output_scale = spec.output_scale
        embed_key, position_key, number_key, layers_key, coalitions_key, head_key = jax.random.split(key, 6)
        self.embed = Linear(spec.n_inputs, SIZE, key=embed_key)
        self.position = jax.random.normal(position_key, (spec.max_steps, SIZE))
        self.index_embeddings = jax.random.normal(number_key, (spec.agents, SIZE))
        self.layers = tuple(TimeLayer(key=key) for key in jax.random.split(layers_key, LAYERS))
        self.coalitions = Coalitions(spec.agents, key=coalitions_key)
        self.head = Linear(SIZE, 1, key=head_key)

    def __call__(self, inputs: Float[Array, "rows agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        """Return the rewards of whole episodes, one after another, each of exactly `spec.max_steps` rows.

        Without a key there is no dropout, and the rewards are means over `REWARD_SAMPLES` samples.
        """
        rows, agents = inputs.shape[:2]
        x = self.embed(inputs).reshape(-1, len(self.position), agents, SIZE)
        x = jnp.swapaxes(x, 1, 2) + self.position
        sample_key, dropout_key, *keys = split_key(key, 2 + LAYERS)
        for layer, layer_key in zip(self.layers, keys, strict=True):
            x = layer(x, layer_key)
        x = jnp.swapaxes(x, 1, 2)
        if sample_key is not None:
            r_hat = self.agent_rewards(x, sample_key, dropout_key)
        else:
            r_hat = mean_over_samples(lambda key: self.agent_rewards(x, key, None))
        return DecoderOutput(r_hat.reshape(rows, agents))

    def agent_rewards(
        self, x: Float[Array, "episodes steps agents size"], key: PRNGKeyArray, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "episodes steps agents"]:
        """Return the agents' rewards for one sample of coalitions and of the order of index embeddings."""
        x = self.coalitions(x, self.index_embeddings, key, dropout_key)
        return self.output_scale * self.head(x)[..., 0]
