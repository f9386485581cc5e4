"""What the agents' values are worth together: QMIX's mixer (Rashid et al., 2018) and VDN's sum (Sunehag et al., 2018).

    Q_tot = elu(q |W_1(s)| + b_1(s)) . |w_2(s)| + b_2(s)        QMIX
    Q_tot = sum_i q_i                                           VDN

Either grows with the value of every agent, so that each agent's best action is its part of the best joint action. QMIX's
weights may depend on the state as they like, since networks of the state, the hypernetworks, write them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare.networks import MLP, Linear


class Mixer(eqx.Module):
    """The hypernetworks. All but b_1's have a hidden layer: b_2's is as wide as the mixer, the others' as `hypernet` says."""

    first: MLP
    """W_1, before its sign is taken away."""
    first_bias: Linear
    second: MLP
    """w_2, likewise."""
    second_bias: MLP

    def __init__(self, agents: int, state_size: int, embed: int, hypernet: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 4)
        self.first = MLP(state_size, (hypernet,), agents * embed, key=keys[0])
        self.first_bias = Linear(state_size, embed, key=keys[1])
        self.second = MLP(state_size, (hypernet,), embed, key=keys[2])
        self.second_bias = MLP(state_size, (embed,), 1, key=keys[3])

    def __call__(
        self, value: Float[Array, "*batch agents"], state: Float[Array, "*batch state"]
    ) -> Float[Array, "*batch"]:
        """Q_tot of the values of the agents' actions."""
        bias = self.first_bias(state)
        weight = jnp.abs(self.first(state)).reshape(*value.shape, bias.shape[-1])
        hidden = jax.nn.elu(jnp.einsum("...n,...ne->...e", value, weight) + bias)
        return jnp.sum(hidden * jnp.abs(self.second(state)), axis=-1) + self.second_bias(state)[..., 0]


def mixed(
    mixer: Mixer | None, value: Float[Array, "*batch agents"], state: Float[Array, "*batch state"]
) -> Float[Array, "*batch"]:
    """Q_tot; without a mixer the sum."""
    return jnp.sum(value, axis=-1) if mixer is None else mixer(value, state)
