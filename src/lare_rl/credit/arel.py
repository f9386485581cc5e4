"""AREL: agent-temporal attention for reward redistribution (Xiao, Ramasubramanian and Poovendran, AAMAS 2022).

Attention over the steps of each agent alternates with attention over the agents of each step. The sum over the agents then
gives one reward for each step, which all agents receive:

    r_hat_{i,t} = y_t = sqrt(T) (w . sum_j h_{j,t}),    penalty = 20 / T^2 E Var_t(y)

The published penalty is 20 E Var_t(y), added to the squared error of the sum of T rewards. Here it is added to the squared
error of their mean, hence 1 / T^2. h are the tokens after all layers, and w includes a bias. The factor is sqrt(T), not the sqrt(nT) of
other decoders (`CreditSpec.output_scale`), because a step has one reward for all agents.
"""

import math
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lare_rl.credit.decoder_network import DecoderOutput
from lare_rl.credit.spec import CreditSpec
from lare_rl.nn.attention import LayerNorm, attend, causal_mask
from lare_rl.nn.networks import MLP, Linear

__all__ = ["AREL", "Block"]

MAX_WIDTH = 100
"""The maximum width of a token."""
DEPTH = 3
"""The number of pairs of blocks."""
HEADS = 3
"""The number of heads in each block. Each head is as wide as a token."""
READ_OUT_WIDTH = 50
"""The width of the layers before the sum over the agents."""
VARIANCE_PENALTY = 20.0


class Block(eqx.Module):
    """y = LN(x + attention(x)), then LN(y + FF(y)), over the tokens."""

    projections: Float[Array, "size projected"]
    """Projects tokens to the queries, keys and values of all heads, without biases."""
    merge: Linear
    feed_forward: MLP
    norms: tuple[LayerNorm, LayerNorm]

    def __init__(self, size: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 3)
        self.projections = Linear(size, 3 * HEADS * size, key=keys[0]).weight
        self.merge = Linear(HEADS * size, size, key=keys[1])
        self.feed_forward = MLP(size, (4 * size,), size, key=keys[2])
        self.norms = LayerNorm(size), LayerNorm(size)

    def __call__(
        self, x: Float[Array, "*batch tokens size"], mask: Bool[Array, "tokens tokens"] | None
    ) -> Float[Array, "*batch tokens size"]:
        projected = jnp.split(x @ self.projections, 3, axis=-1)
        query, key, value = (values.reshape(*x.shape[:-1], HEADS, x.shape[-1]) for values in projected)
        y = self.norms[0](x + self.merge(attend(query, key, value, mask)))
        return self.norms[1](y + self.feed_forward(y))


class AREL(eqx.Module):
    """The published network, layer by layer."""

    embed: Linear
    position: Float[Array, "steps size"]
    time_blocks: tuple[Block, ...]
    agent_blocks: tuple[Block, ...]
    read_out: tuple[Linear, ...]

    def __init__(self, key: PRNGKeyArray, spec: CreditSpec):
        size = min(spec.n_inputs, MAX_WIDTH)
        embed_key, position_key, time_key, agents_key, *read_keys = jax.random.split(key, 7)
        self.embed = Linear(spec.n_inputs, size, key=embed_key)
        self.position = jax.random.normal(position_key, (spec.max_steps, size))
        self.time_blocks = tuple(Block(size, key=key) for key in jax.random.split(time_key, DEPTH))
        self.agent_blocks = tuple(Block(size, key=key) for key in jax.random.split(agents_key, DEPTH))
        widths = pairwise((size, READ_OUT_WIDTH, READ_OUT_WIDTH, 1))
        self.read_out = tuple(Linear(*width, key=key) for width, key in zip(widths, read_keys, strict=True))

    def __call__(self, inputs: Float[Array, "rows agents inputs"], key: PRNGKeyArray | None) -> DecoderOutput:
        steps = len(self.position)
        rows, agents = inputs.shape[:2]
        x = self.embed(inputs).reshape(-1, steps, agents, self.position.shape[-1])
        x = jnp.swapaxes(x, 1, 2) + self.position
        for time_block, agent_block in zip(self.time_blocks, self.agent_blocks, strict=True):
            x = time_block(x, causal_mask(steps))
            x = jnp.swapaxes(agent_block(jnp.swapaxes(x, 1, 2), None), 1, 2)
        first, second, last = self.read_out
        y = math.sqrt(steps) * last(jnp.sum(second(first(x)), axis=1))[..., 0]
        penalty = VARIANCE_PENALTY / steps**2 * jnp.var(y, axis=1, ddof=min(1, steps - 1), keepdims=True)
        outputs = y, jnp.broadcast_to(penalty, y.shape)
        return DecoderOutput(*(jnp.broadcast_to(values.reshape(rows, 1), (rows, agents)) for values in outputs))
