"""Translates functions of JAX to operations of a graph, that of the `building` block around the call. Shapes are those of one row."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.errors import LareError
from lare_rl.phi.arrays import Array, as_array
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import Graph, NumberKind, all_positions
from lare_rl.phi.numpy_functions import FUNCTIONS, call_numpy
from lare_rl.training.numpy_program import Operation, UnsupportedOperationError, to_numpy

__all__ = ["add_function", "finish", "graph_input"]

JAX_DTYPES = {"float": np.float32, "int": np.int32, "bool": np.bool_}
"""The types of JAX for kinds of numbers."""


def graph_input(name: str, shape: tuple[int, ...], kind: NumberKind = "float") -> Array:
    """Add an input to the graph."""
    return Array(current_builder().input(name, shape, kind), None)


def finish(**outputs: Any) -> Graph:
    """Return the graph of these outputs."""
    return current_builder().finish({name: as_array(array).node for name, array in outputs.items()})


def add_function(function: Callable[[dict[str, Any]], Any], arrays: dict[str, Array]) -> Any:
    """Add the operations of a function of JAX, from arrays by name to a pytree of arrays. Return its results.

    Raises:
        LareError: one of its operations cannot be translated.
    """
    shapes = {name: jax.ShapeDtypeStruct(array.row_shape, JAX_DTYPES[array.kind]) for name, array in arrays.items()}
    try:
        return to_numpy(function, shapes, array_functions=_find_function)(arrays)()
    except UnsupportedOperationError as error:
        raise LareError(
            f"a function of this run cannot be exported, because its operation {str(error)!r} is not translated: load the policy in "
            "Python with lare_rl.load_policy"
        ) from error


def _find_function(name: str) -> Operation:
    if name == "gather":
        return _gather
    if name not in FUNCTIONS:
        raise UnsupportedOperationError(name)
    return lambda *args, **kwargs: call_numpy(name, args, kwargs)


def _gather(equation: Any, x: Any, indices: Any) -> Array:
    """Take numbers at fixed positions. JAX itself moves the positions as it would move the numbers."""
    array, index = as_array(x), as_array(indices).constant
    if index is None:
        raise UnsupportedOperationError("gather at computed positions")
    positions = jnp.asarray(all_positions(array.row_shape))
    params = equation.params | {"fill_value": -1}
    moved = np.asarray(equation.primitive.bind(positions, jnp.asarray(index, jnp.int32), **params))
    if (moved < 0).any():
        raise UnsupportedOperationError("gather outside of an array")
    return Array(current_builder().gather(array.node, moved), None)
