"""Layers of networks as operations of a graph: that of the `building` block around the calls. An array has the axes of one row."""

from typing import Any

import equinox as eqx
import numpy as np

from lare_rl.nn.networks import MLP, Linear
from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import Graph, Kind
from lare_rl.phi.numpy_functions import call_numpy

__all__ = ["finish", "first_outputs", "graph_input", "linear", "network", "numpy_op", "sigmoid", "standardize"]


def graph_input(name: str, shape: tuple[int, ...], kind: Kind = "float") -> Array:
    """Add an input to the graph."""
    return Array(current_builder().input(name, shape, kind), None)


def finish(**outputs: Any) -> Graph:
    """Return the graph of these outputs."""
    return current_builder().finish({name: array.node for name, array in outputs.items()})


def numpy_op(name: str, *args: Any, **kwargs: Any) -> Any:
    """Apply a function of NumPy to arrays of the graph."""
    return call_numpy(name, args, kwargs)


def linear(x: Array, layer: Linear) -> Any:
    """Return x W + b."""
    return numpy_op("matmul", x, np.asarray(layer.weight)) + np.asarray(layer.bias)


def network(x: Array, mlp: MLP, activation: str = "relu") -> Any:
    """Apply a network with ReLU or tanh between its layers."""
    *hidden, last = mlp.layers
    for layer in hidden:
        x = linear(x, layer)
        x = elementwise("maximum", x, 0.0) if activation == "relu" else elementwise("tanh", x)
    return linear(x, last)


def first_outputs(mlp: MLP, n_outputs: int) -> MLP:
    """Return the network with only the first of its outputs."""
    last = mlp.layers[-1]
    return eqx.tree_at(
        lambda net: (net.layers[-1].weight, net.layers[-1].bias),
        mlp,
        (last.weight[:, :n_outputs], last.bias[:n_outputs]),
    )


def sigmoid(x: Array) -> Any:
    """Return 1 / (1 + exp(-x))."""
    return elementwise("divide", 1.0, elementwise("exp", -x) + 1.0)  # pyright: ignore


def standardize(x: Array, mean: Any, std: Any, limit: float | None = None) -> Any:
    """Return (x - mean) / std, clipped to ±limit, and 0 where the standard deviation is 0."""
    std = np.asarray(std, np.float64)
    inverse = np.where(std > 0, 1 / np.where(std > 0, std, 1), 0)
    u = (x - as_array(np.asarray(mean))) * inverse  # pyright: ignore
    return u if limit is None else numpy_op("clip", u, -limit, limit)
