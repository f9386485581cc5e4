"""The networks of QMIX (Rashid et al., 2018), and VDN's sum (Sunehag et al., 2018).

    u_t = relu(x_t A + a)        h_t = GRU(u_t, h_{t-1}), h_{-1} = 0        Q_t = h_t B + b

Q_t are the values of an agent's actions, given all that it has observed. All agents share this network, and x_t includes the
agent's index. A mixer computes the team's value from the value q_i of each agent's action:

    Q_tot = elu(q |W_1(s)| + b_1(s)) . |w_2(s)| + b_2(s)        QMIX
    Q_tot = sum_i q_i                                           VDN

Both increase with the value of every agent, so that the best joint action consists of each agent's best action. QMIX's weights
are the outputs of networks of the state, the hypernetworks, and may depend on the state in any way.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import GRU, MLP, Linear

__all__ = ["Mixer", "RecurrentNetwork", "mix"]


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

        def step(h: Float[Array, "*batch hidden"], projected: Float[Array, "*batch gates"]):
            h = self.gru(projected, h)
            return h, h

        h = jnp.zeros((*x.shape[1:-1], self.head.weight.shape[-2]))
        return self.head(jax.lax.scan(step, h, self._project(x))[1])

    def _project(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch gates"]:
        return self.gru.input_projection(jax.nn.relu(self.encoder(x)))


class Mixer(eqx.Module):
    """The hypernetworks. That of b_1 is linear. The others have one hidden layer, of width `embed` for b_2, else `hypernet`."""

    first: MLP
    """W_1, before the absolute value is taken."""
    first_bias: Linear
    second: MLP
    """w_2, before the absolute value is taken."""
    second_bias: MLP

    def __init__(self, n_agents: int, state_size: int, embed: int, hypernet: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 4)
        self.first = MLP(state_size, (hypernet,), n_agents * embed, key=keys[0])
        self.first_bias = Linear(state_size, embed, key=keys[1])
        self.second = MLP(state_size, (hypernet,), embed, key=keys[2])
        self.second_bias = MLP(state_size, (embed,), 1, key=keys[3])

    def __call__(
        self, value: Float[Array, "*batch agents"], state: Float[Array, "*batch state"]
    ) -> Float[Array, "*batch"]:
        """Return Q_tot of the values of the agents' actions."""
        bias = self.first_bias(state)
        weight = jnp.abs(self.first(state)).reshape(*value.shape, bias.shape[-1])
        hidden = jax.nn.elu(jnp.einsum("...n,...ne->...e", value, weight) + bias)
        return jnp.sum(hidden * jnp.abs(self.second(state)), axis=-1) + self.second_bias(state)[..., 0]


def mix(
    mixer: Mixer | None, value: Float[Array, "*batch agents"], state: Float[Array, "*batch state"]
) -> Float[Array, "*batch"]:
    """Return Q_tot. Without a mixer, it is the sum of the values."""
    return jnp.sum(value, axis=-1) if mixer is None else mixer(value, state)
