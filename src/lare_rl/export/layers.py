"""Layers of networks as operations of a graph. An array has the axes of one row; the graph is that of `building`."""

from typing import Any

import numpy as np

from lare_rl.nn.networks import MLP, Linear
from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.graph import Graph, Kind, current_builder
from lare_rl.phi.numpy_functions import call_numpy


def graph_input(name: str, shape: tuple[int, ...], kind: Kind = "float") -> Array:
    """An array that the caller of the graph gives."""
    return Array(current_builder().input(name, shape, kind), None)


def finish(**outputs: Any) -> Graph:
    """The graph of these outputs."""
    return current_builder().finish({name: array.node for name, array in outputs.items()})


def numpy(name: str, *args: Any, **kwargs: Any) -> Any:
    """A function of NumPy, on arrays of the graph."""
    return call_numpy(name, args, kwargs)


def linear(x: Array, layer: Linear) -> Any:
    """X W + b."""
    return numpy("matmul", x, np.asarray(layer.weight)) + np.asarray(layer.bias)


def network(x: Array, mlp: MLP, activation: str = "relu") -> Any:
    """A network with ReLU or tanh between its layers."""
    *hidden, last = mlp.layers
    for layer in hidden:
        x = linear(x, layer)
        x = elementwise("maximum", x, 0.0) if activation == "relu" else elementwise("tanh", x)
    return linear(x, last)


def sigmoid(x: Array) -> Any:
    return elementwise("divide", 1.0, elementwise("exp", -x) + 1.0)  # pyright: ignore


def standardize(x: Array, mean: Any, deviation: Any, most: float | None = None) -> Any:
    """(x - mean) / deviation, clipped to ±most; 0 where the deviation is 0."""
    deviation = np.asarray(deviation, np.float64)
    inverse = np.where(deviation > 0, 1 / np.where(deviation > 0, deviation, 1), 0)
    u = (x - as_array(np.asarray(mean))) * inverse  # pyright: ignore
    return u if most is None else numpy("clip", u, -most, most)
