"""Networks of actors, critics and decoders, and updates of their parameters."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

__all__ = [
    "GRU",
    "MLP",
    "Linear",
    "adam_step",
    "bound_log_std",
    "clip_gradient",
    "copy_networks",
    "init_adam",
    "init_orthogonal",
    "polyak_update",
]

MAX_LOG_STD = 5.0


class Linear(eqx.Module):
    """x W + b.

    The weight has the shape (in, out), unlike that of `equinox.nn.Linear`: neither the forward nor the backward pass has to
    transpose it.
    """

    weight: Float[Array, "*stack in out"]
    bias: Float[Array, "*stack out"]

    def __init__(self, in_size: int, out_size: int, *, key: PRNGKeyArray):
        weight_key, bias_key = jax.random.split(key)
        bound = in_size**-0.5
        self.weight = jax.random.uniform(weight_key, (in_size, out_size), minval=-bound, maxval=bound)
        self.bias = jax.random.uniform(bias_key, (out_size,), minval=-bound, maxval=bound)

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        return x @ self.weight + self.bias


class MLP(eqx.Module):
    """Linear layers with an activation between them, ReLU by default.

    `MLP(3, (256, 256), 1, key=key)` is `Linear(3, 256)`, ReLU, `Linear(256, 256)`, ReLU, `Linear(256, 1)`. Weights and biases start
    uniform in ±1/sqrt(fan-in). All leaves are arrays, so a training state can be scanned, vmapped and saved as one pytree.
    """

    layers: tuple[Linear, ...]
    activation: Callable[[Array], Array] = eqx.field(static=True)

    def __init__(
        self,
        in_size: int,
        hidden: tuple[int, ...],
        out_size: int,
        *,
        key: PRNGKeyArray,
        activation: Callable[[Array], Array] = jax.nn.relu,
    ):
        sizes = (in_size, *hidden, out_size)
        keys = jax.random.split(key, len(sizes) - 1)
        self.layers = tuple(
            Linear(fan_in, fan_out, key=layer_key)
            for fan_in, fan_out, layer_key in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )
        self.activation = activation

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        for layer in self.layers[:-1]:
            x = self.activation(layer(x))
        return self.layers[-1](x)


class GRU(eqx.Module):
    """A gated recurrent unit (Cho et al., 2014), as in cuDNN and PyTorch.

        z = sigmoid(x U_z + h W_z)    r = sigmoid(x U_r + h W_r)    n = tanh(x U_n + r * (h W_n))    h' = (1 - z) n + z h

    Each of the six products has a bias.
    """

    input_projection: Linear
    """U_z, U_r and U_n side by side."""
    hidden_projection: Linear
    """W_z, W_r and W_n side by side."""

    def __init__(self, in_size: int, size: int, *, key: PRNGKeyArray):
        input_key, hidden_key = jax.random.split(key)
        self.input_projection = Linear(in_size, 3 * size, key=input_key)
        self.hidden_projection = Linear(size, 3 * size, key=hidden_key)

    def __call__(
        self, projected: Float[Array, "*batch gates"], h: Float[Array, "*batch size"]
    ) -> Float[Array, "*batch size"]:
        """Return h'. `projected` is x U, which a caller computes for all steps at once."""
        z, r, n = jnp.split(projected, 3, axis=-1)
        hidden_z, hidden_r, hidden_n = jnp.split(self.hidden_projection(h), 3, axis=-1)
        z, r = jax.nn.sigmoid(z + hidden_z), jax.nn.sigmoid(r + hidden_r)
        return (1 - z) * jnp.tanh(n + r * hidden_n) + z * h


def init_orthogonal(network: MLP, last_gain: float, *, key: PRNGKeyArray) -> MLP:
    """Return the network with zero biases and orthogonal weights (Saxe et al., 2014).

    Args:
        last_gain: the gain of the last layer. The other layers have gain 1.
    """

    def init_layer(layer: Linear, gain: float, layer_key: PRNGKeyArray) -> Linear:
        weight = jax.nn.initializers.orthogonal(gain)(layer_key, layer.weight.shape)
        return eqx.tree_at(lambda layer: (layer.weight, layer.bias), layer, (weight, jnp.zeros_like(layer.bias)))

    gains = (1.0,) * (len(network.layers) - 1) + (last_gain,)
    keys = jax.random.split(key, len(network.layers))
    return eqx.tree_at(lambda network: network.layers, network, tuple(map(init_layer, network.layers, gains, keys)))


def bound_log_std(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the log of a standard deviation within ±5, so that no likelihood is infinite, with a gradient everywhere.

    It is nearly x where x is far from the bounds.
    """
    return MAX_LOG_STD * jnp.tanh(x / MAX_LOG_STD)


Parameters = TypeVar("Parameters")


def init_adam(parameters: Any, learning_rate: float) -> optax.OptState:
    """Return the initial state of Adam."""
    return optax.adam(learning_rate).init(parameters)


def adam_step(
    parameters: Parameters, gradient: Parameters, state: optax.OptState, learning_rate: float | Array
) -> tuple[Parameters, optax.OptState]:
    """Take one step of Adam (Kingma and Ba, 2015) against the gradient."""
    updates, state = optax.adam(cast(float, learning_rate)).update(cast(Any, gradient), state)
    return cast(Parameters, optax.apply_updates(cast(Any, parameters), updates)), state


def clip_gradient(gradient: Parameters, max_norm: float) -> Parameters:
    """Return the gradient, scaled down to the norm `max_norm` if its norm is larger (Pascanu et al., 2013)."""
    factor = max_norm / jnp.maximum(optax.tree.norm(gradient), max_norm)
    return jax.tree.map(lambda leaf: leaf * factor, gradient)


def copy_networks(networks: Parameters) -> Parameters:
    """Return target networks: copies, because one buffer cannot be donated twice to a compiled update."""
    return jax.tree.map(jnp.copy, networks)


def polyak_update(target: Parameters, online: Parameters, tau: float) -> Parameters:
    """Return (1 - tau) target + tau online, leaf by leaf."""
    return jax.tree.map(lambda old, new: old + tau * (new - old), target, online)
