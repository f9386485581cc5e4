"""From the agents' values to the team's value: QMIX's mixer (Rashid et al., 2018) and VDN's sum (Sunehag et al., 2018).

    Q_tot = elu(q |W_1(s)| + b_1(s)) . |w_2(s)| + b_2(s)        QMIX
    Q_tot = sum_i q_i                                           VDN

Both increase with the value of every agent, so that the best joint action consists of each agent's best action. QMIX's weights
are the outputs of networks of the state, the hypernetworks, and may depend on the state in any way.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import MLP, Linear

__all__ = ["Mixer", "mix"]


class Mixer(eqx.Module):
    """The hypernetworks. That of b_1 is linear. The others have one hidden layer, of width `embed` for b_2, else `hypernet`."""

    first: MLP
    """W_1, before the absolute value is taken."""
    first_bias: Linear
    second: MLP
    """w_2, before the absolute value is taken."""
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
