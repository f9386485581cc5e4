"""Computes a graph for any number of rows, with NumPy or jax.numpy: under `jax.jit`, `vmap` and `grad`, on any device.

An array has the axes of its row last. In front of them are the batch axes, as many as the caller has: (observation size,),
(batch, observation size), (seeds, time, envs, observation size). Operations name their axes from the end, so they never touch
a batch axis. Constants have no batch axes. `lare-rl export` copies this file next to the exported graphs, so it may import
NumPy only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lare_rl.phi.graph import Graph, Node

__all__ = ["compute", "compute_nodes", "evaluate"]

MAX_INT32_IN_FLOAT32 = 2.0**31 - 128
"""The largest float32 that an int32 can hold."""


def evaluate(graph: Graph, inputs: Mapping[str, Any], xp: Any = np, dtype: Any = np.float32) -> dict[str, Any]:
    """Compute the outputs of a graph, each of shape (*batch, *row).

    Args:
        inputs: for each of its inputs, an array of shape (*batch, *row).
        xp: `numpy` or `jax.numpy`.
        dtype: the type of floating-point numbers. Integers are int64 for float64, else int32.
    """
    batch, values = _batch_shape(graph, inputs), compute_nodes(graph, inputs, xp, dtype)
    return {name: xp.broadcast_to(values[i], (*batch, *graph.nodes[i].shape)) for name, i in graph.outputs.items()}


def compute_nodes(
    graph: Graph, inputs: Mapping[str, Any], xp: Any = np, dtype: Any = np.float32, keep: bool = False
) -> list[Any]:
    """Compute the result of every node. Unless `keep` is true, a result that is not an output becomes None after its last use."""
    batch = _batch_shape(graph, inputs)
    values: list[Any] = []
    with np.errstate(all="ignore"):
        for node, unused in zip(graph.nodes, graph.unused_after, strict=True):
            if node.op == "input":
                values.append(xp.asarray(inputs[node.option], _dtypes(dtype)[node.kind]))
            elif node.op == "constant":
                values.append(_cast_constant(node.option, _dtypes(dtype)[node.kind]))
            else:
                values.append(compute(node, [values[i] for i in node.inputs], batch, xp, dtype))
            for i in () if keep else unused:
                values[i] = None
    return values


def _cast_constant(values: np.ndarray, dtype: Any) -> np.ndarray:
    """Cast the numbers of a constant. An integer that is too large becomes the largest one, as in casts of fractions."""
    if values.dtype == np.int64 and np.dtype(dtype) == np.int32:
        limits = np.iinfo(np.int32)
        values = np.clip(values, limits.min, limits.max)
    return values.astype(dtype)


def compute(node: Node, x: Sequence[Any], batch: tuple[int, ...], xp: Any = np, dtype: Any = np.float64) -> Any:
    """Compute the result of one operation.

    Args:
        x: the results of its inputs, each of shape (*batch, *row); constants have the shape of their row.
        batch: the batch axes.
        xp: `numpy` or `jax.numpy`.
        dtype: the type of floating-point numbers.
    """
    option = node.option
    match node.op:
        case "gather":  # a box is read by slices, which costs less
            if option.slices is not None:
                result = x[0][(..., *option.slices)].reshape((*batch, *node.shape))
            else:
                result = x[0].reshape((*batch, math.prod(x[0].shape[len(batch) :])))[..., option.positions]
        case "concat":
            result = xp.concatenate([xp.broadcast_to(array, (*batch, array.shape[-1])) for array in x], -1)
        case "take":
            table, index = x[0], xp.clip(x[1], 0, x[0].shape[-1] - 1)
            if table.ndim == 1:  # a constant, or a single row
                result = xp.asarray(table)[index]
            else:
                flat = xp.broadcast_to(index, (*batch, *node.shape)).reshape((*batch, math.prod(node.shape)))
                result = xp.take_along_axis(table, flat, -1).reshape((*batch, *node.shape))
        case "cast" if node.kind == "int" and x[0].dtype != bool:
            result = xp.where(xp.isnan(x[0]), 0, xp.clip(x[0], -MAX_INT32_IN_FLOAT32, MAX_INT32_IN_FLOAT32))
        case "cast":
            result = x[0] != 0 if node.kind == "bool" else x[0]
        case "einsum":
            result = xp.einsum(option, *x, **({} if xp is np else {"precision": "highest"}))
        case "floor_divide" | "remainder" | "fmod" if node.kind == "int":
            result = xp.where(x[1] == 0, 0, getattr(xp, node.op)(x[0], xp.where(x[1] == 0, 1, x[1])))
        case "power" if node.kind == "int":
            result = getattr(xp, node.op)(x[0], xp.maximum(x[1], 0))
        case "det":
            result = xp.linalg.det(x[0])
        case "sum" | "prod" | "max" | "min" | "any" | "all" | "argmax" | "argmin" | "cumsum" | "cumprod" | "sort":
            result = getattr(xp, node.op)(x[0], axis=option)
        case "argsort":
            result = xp.argsort(x[0], axis=option, stable=True)
        case _:  # an operation on each number
            result = getattr(xp, node.op)(*x)
    return xp.asarray(result, _dtypes(dtype)[node.kind])


def _batch_shape(graph: Graph, inputs: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the shape of the batch axes, which all inputs share."""
    for node in graph.nodes:
        if node.op == "input":
            shape = np.shape(inputs[node.option])
            return shape[: len(shape) - len(node.shape)]
    return ()


def _dtypes(dtype: Any) -> dict[str, Any]:
    """Return the type of the numbers of each kind."""
    return {"float": dtype, "int": np.int64 if dtype is np.float64 else np.int32, "bool": bool}
