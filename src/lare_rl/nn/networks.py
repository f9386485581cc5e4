"""The network shapes that actors, critics and decoders share, and the steps that change their parameters."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray


class Linear(eqx.Module):
    """x W + b. The weight is stored as (in, out), so that neither the forward nor the backward pass has to transpose it."""

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

    `MLP(3, (256, 256), 1, key=key)` is `Linear(3, 256)`, ReLU, `Linear(256, 256)`, ReLU, `Linear(256, 1)`.
    Weights and biases start uniform in ±1/sqrt(fan-in). Every leaf is an array, so that a whole training state can
    be scanned, vmapped and saved as one pytree.
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

        z = s(x U_z + h W_z)    r = s(x U_r + h W_r)    n = tanh(x U_n + r * (h W_n))    h' = (1 - z) n + z h

    with a bias in each of the six products.
    """

    given: Linear
    """U_z, U_r and U_n side by side."""
    kept: Linear
    """W_z, W_r and W_n side by side."""

    def __init__(self, features: int, size: int, *, key: PRNGKeyArray):
        given_key, kept_key = jax.random.split(key)
        self.given, self.kept = Linear(features, 3 * size, key=given_key), Linear(size, 3 * size, key=kept_key)

    def __call__(
        self, given: Float[Array, "*batch three"], h: Float[Array, "*batch size"]
    ) -> Float[Array, "*batch size"]:
        """One step; `given` is x U, which a caller has computed for all steps at once."""
        (z, r, n), (kept_z, kept_r, kept_n) = (jnp.split(part, 3, axis=-1) for part in (given, self.kept(h)))
        z, r = jax.nn.sigmoid(z + kept_z), jax.nn.sigmoid(r + kept_r)
        return (1 - z) * jnp.tanh(n + r * kept_n) + z * h


def orthogonal(network: MLP, last_gain: float, *, key: PRNGKeyArray) -> MLP:
    """The same network with orthogonal weights (Saxe et al., 2014), of gain 1 (`last_gain` in the last layer), and zero biases."""
    keys = jax.random.split(key, len(network.layers))
    gains = (1.0,) * (len(network.layers) - 1) + (last_gain,)
    started = tuple(
        eqx.tree_at(
            lambda layer: (layer.weight, layer.bias),
            layer,
            (jax.nn.initializers.orthogonal(gain)(layer_key, layer.weight.shape), jnp.zeros_like(layer.bias)),
        )
        for layer, gain, layer_key in zip(network.layers, gains, keys, strict=True)
    )
    return eqx.tree_at(lambda network: network.layers, network, started)


Parameters = TypeVar("Parameters")


def start_adam(parameters: Any, learning_rate: float) -> optax.OptState:
    """The state of Adam before its first step."""
    return optax.adam(learning_rate).init(parameters)


def descend(
    parameters: Parameters, gradient: Parameters, state: optax.OptState, learning_rate: float | Array
) -> tuple[Parameters, optax.OptState]:
    """One step of Adam (Kingma and Ba, 2015) against the gradient."""
    change, state = optax.adam(cast(float, learning_rate)).update(cast(Any, gradient), state)
    return cast(Parameters, optax.apply_updates(cast(Any, parameters), change)), state


def clipped(gradient: Parameters, most: float) -> Parameters:
    """The gradient, scaled down to the norm `most` if its norm is larger (Pascanu et al., 2013)."""
    shrink = most / jnp.maximum(optax.tree.norm(gradient), most)
    return jax.tree.map(lambda leaf: leaf * shrink, gradient)


def move_towards(target: Parameters, online: Parameters, tau: float) -> Parameters:
    """(1 - tau) target + tau online, leaf by leaf."""
    return jax.tree.map(lambda old, new: old + tau * (new - old), target, online)
