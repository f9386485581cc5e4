"""The agent network of QMIX (Rashid et al., 2018).

    u_t = relu(x_t A + a)        h_t = GRU(u_t, h_{t-1}), h_{-1} = 0        Q_t = h_t B + b

Q_t are the values of an agent's actions, given all that it has observed. All agents share the network, and x_t includes the
agent's index.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import GRU, Linear

__all__ = ["RecurrentNetwork"]


class RecurrentNetwork(eqx.Module):
    """Linear, ReLU, GRU, Linear.

    The GRU's input is as wide as its hidden state, so that all its parameters start uniform in ±1/sqrt(width), as in PyTorch.
    """

    encoder: Linear
    gru: GRU
    head: Linear

    def __init__(self, in_size: int, hidden: int, out_size: int, *, key: PRNGKeyArray):
        encoder_key, gru_key, head_key = jax.random.split(key, 3)
        self.encoder = Linear(in_size, hidden, key=encoder_key)
        self.gru = GRU(hidden, hidden, key=gru_key)
        self.head = Linear(hidden, out_size, key=head_key)

    def __call__(
        self, x: Float[Array, "*batch in"], h: Float[Array, "*batch hidden"]
    ) -> tuple[Float[Array, "*batch out"], Float[Array, "*batch hidden"]]:
        """Return the output of one step, and the new hidden state."""
        h = self.gru(self._project(x), h)
        return self.head(h), h

    def unroll(self, x: Float[Array, "time *batch in"]) -> Float[Array, "time *batch out"]:
        """Return the outputs of all steps, from a hidden state of zeros."""

        def step(h: Float[Array, "*batch hidden"], projected: Float[Array, "*batch three"]):
            h = self.gru(projected, h)
            return h, h

        h = jnp.zeros((*x.shape[1:-1], self.head.weight.shape[-2]))
        return self.head(jax.lax.scan(step, h, self._project(x))[1])

    def _project(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch three"]:
        return self.gru.input_projection(jax.nn.relu(self.encoder(x)))
