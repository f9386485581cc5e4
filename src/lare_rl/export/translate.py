"""Adds the operations of JAX functions to the graph of the block `with building(...)` (`phi/builder.py`) around the call.

Shapes are those of one row.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.errors import LareError
from lare_rl.phi.arrays import Array, as_array
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import Graph, NumberKind, all_positions
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions import FUNCTIONS, call_numpy
from lare_rl.training.numpy_program import Operation, UnsupportedOperationError, to_numpy
from lare_rl.util.sanitize import one_line

__all__ = ["add_function", "finish", "graph_input"]

JAX_DTYPES = {"float": np.float32, "int": np.int32, "bool": np.bool_}
"""The types of JAX for kinds of numbers."""


def graph_input(name: str, shape: tuple[int, ...], kind: NumberKind = "float") -> Array:
    """Add an input to the graph."""
    return Array(current_builder().input(name, shape, kind), batch_axis=None)


def finish(**outputs: Any) -> Graph:
    """Return the graph of these outputs."""
    return current_builder().finish({name: as_array(array).node for name, array in outputs.items()})


def add_function(function: Callable[[dict[str, Any]], Any], arrays: dict[str, Array], hint: str = "") -> Any:
    """Add the operations of a JAX function, which takes arrays by name and returns a pytree of arrays. Return its results.

    Raises:
        LareError: one of its operations cannot be translated. The message ends with the hint.
    """
    shapes = {name: jax.ShapeDtypeStruct(array.row_shape, JAX_DTYPES[array.kind]) for name, array in arrays.items()}
    try:
        # "NumPy" means NumPy's names here: the functions add nodes. All inputs are the first argument; there are no others.
        return to_numpy(function, shapes, array_functions=_find_function)(arrays)()
    except RefusedError as error:
        raise LareError(f"a function of this run cannot be exported: {one_line(error)}{hint}") from error
    except UnsupportedOperationError as error:
        raise LareError(
            f"a function of this run cannot be exported, because its operation {one_line(error)!r} is not translated{hint}"
        ) from error


def _find_function(name: str) -> Operation:
    if name == "gather":
        return _gather
    if name not in FUNCTIONS:
        raise UnsupportedOperationError(name)
    return lambda *args, **kwargs: call_numpy(name, args, kwargs)


def _gather(equation: Any, x: Any, indices: Any) -> Array:
    """Take numbers at fixed positions. JAX gathers from 0, 1, 2, ... in the array's shape, which shows where each number comes from."""
    array, index = as_array(x), as_array(indices).constant
    if index is None:
        raise UnsupportedOperationError("gather at computed positions")
    positions = jnp.asarray(all_positions(array.row_shape))
    params = equation.params | {"fill_value": -1}
    moved = np.asarray(equation.primitive.bind(positions, jnp.asarray(index, jnp.int32), **params))
    if (moved < 0).any():
        raise UnsupportedOperationError("gather outside of an array")
    return Array(current_builder().gather(array.node, moved), batch_axis=None)
