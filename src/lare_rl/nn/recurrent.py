"""The agent network of QMIX: the values of one agent's actions, given all that it has observed (Rashid et al., 2018).

    u_t = relu(x_t A + a)        h_t = GRU(u_t, h_{t-1}), h_{-1} = 0        Q_t = h_t B + b

All agents share it; x_t includes the agent's index.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import GRU, Linear


class Recurrent(eqx.Module):
    """Linear, ReLU, GRU, Linear.

    The GRU's input is as wide as its memory, so that all its parameters start uniform in ±1/sqrt(width), as in PyTorch.
    """

    encoder: Linear
    memory: GRU
    decoder: Linear

    def __init__(self, in_size: int, hidden: int, out_size: int, *, key: PRNGKeyArray):
        encoder_key, memory_key, decoder_key = jax.random.split(key, 3)
        self.encoder = Linear(in_size, hidden, key=encoder_key)
        self.memory = GRU(hidden, hidden, key=memory_key)
        self.decoder = Linear(hidden, out_size, key=decoder_key)

    def given(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch three"]:
        """The part of the GRU's step that depends on the input alone."""
        return self.memory.given(jax.nn.relu(self.encoder(x)))

    def __call__(
        self, x: Float[Array, "*batch in"], h: Float[Array, "*batch hidden"]
    ) -> tuple[Float[Array, "*batch out"], Float[Array, "*batch hidden"]]:
        """One step: the output, and the new memory."""
        h = self.memory(self.given(x), h)
        return self.decoder(h), h

    def unroll(self, x: Float[Array, "time *batch in"]) -> Float[Array, "time *batch out"]:
        """All steps, from an empty memory. Only the products with the memory are computed one step after the other."""

        def one(h: Float[Array, "*batch hidden"], given: Float[Array, "*batch three"]):
            h = self.memory(given, h)
            return h, h

        nothing = jnp.zeros((*x.shape[1:-1], self.decoder.weight.shape[-2]))
        return self.decoder(jax.lax.scan(one, nothing, self.given(x))[1])
