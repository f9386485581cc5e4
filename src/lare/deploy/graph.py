"""A function of arrays as a list of operations. Both exported forms are written from it: ONNX, and NumPy arrays.

Operations have the names and the meaning that ONNX gives them. `exported.py` implements each of them in NumPy.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lare.networks import MLP, Linear

BATCH = "batch"
"""The first axis of every input and output: any number of rows."""


class Operation(NamedTuple):
    """One operation. Its arguments are names of inputs, of constants or of earlier results."""

    name: str
    arguments: tuple[str, ...]
    result: str
    axis: int | None = None
    """The axis, for an operation that needs one."""


@dataclass(frozen=True)
class Graph:
    """Operations, in order. A method adds an operation, and returns the name of its result."""

    inputs: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """The shape of each, without the batch."""
    kinds: dict[str, str] = field(default_factory=dict)
    """The type of each input and output."""
    constants: dict[str, np.ndarray] = field(default_factory=dict)
    operations: list[Operation] = field(default_factory=list)
    outputs: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """The shape of each, without the batch."""

    def input(self, name: str, shape: tuple[int, ...], kind: str = "float32") -> str:
        """An array that the caller gives."""
        self.inputs[name], self.kinds[name] = shape, kind
        return name

    def constant(self, value: object) -> str:
        """An array that never changes."""
        array = np.asarray(value)
        name = f"constant_{len(self.constants)}"
        self.constants[name] = array.astype(np.float32) if array.dtype.kind == "f" else array
        return name

    def apply(self, operation: str, *arguments: object, result: str | None = None, axis: int | None = None) -> str:
        """Add an operation. Arguments that are not names become constants."""
        names = tuple(one if isinstance(one, str) else self.constant(one) for one in arguments)
        name = result or f"value_{len(self.operations)}"
        self.operations.append(Operation(operation, names, name, axis))
        return name

    def output(self, name: str, value: str, shape: tuple[int, ...], kind: str = "float32") -> None:
        """Make a result an output, with this name."""
        self.apply("Identity", value, result=name)
        self.outputs[name], self.kinds[name] = shape, kind

    def linear(self, x: str, layer: Linear) -> str:
        """A linear layer: x W + b."""
        return self.apply("Add", self.apply("MatMul", x, np.asarray(layer.weight)), np.asarray(layer.bias))

    def network(self, x: str, network: MLP, activation: str) -> str:
        """A network, with the activation between its layers."""
        *hidden, last = network.layers
        for layer in hidden:
            x = self.apply(activation, self.linear(x, layer))
        return self.linear(x, last)

    def clip(self, x: str, low: object, high: object) -> str:
        """Clip to bounds, which may be arrays."""
        return self.apply("Min", self.apply("Max", x, np.asarray(low, np.float32)), np.asarray(high, np.float32))

    def standardised(self, x: str, mean: object, deviation: object, most: float | None = None) -> str:
        """(x - mean) / deviation, clipped to ±`most`; 0 where the deviation is 0."""
        spread = np.asarray(deviation, np.float64)
        inverse = np.where(spread > 0, 1 / np.where(spread > 0, spread, 1), 0).astype(np.float32)
        u = self.apply("Mul", self.apply("Sub", x, np.asarray(mean, np.float32)), inverse)
        return u if most is None else self.clip(u, -most, most)
