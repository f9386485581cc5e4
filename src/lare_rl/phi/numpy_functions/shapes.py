"""Functions of the shape of an array: reshape, transpose, broadcast, join, split, insert, delete."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, broadcast, concatenate, stack
from lare_rl.phi.builder import current_builder
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_arrays,
    as_list,
    numpy_function,
    numpy_functions,
    numpy_variants,
    require_constant,
)
from lare_rl.phi.operand import BATCH, BatchSize, common_batch_axis


def split_shape(shape: Any) -> tuple[tuple[int, ...], int | None]:
    """Return a shape that a program names as the shape in the graph and the batch axis."""
    sizes = as_list(shape)
    batch_axes = [axis for axis, size in enumerate(sizes) if isinstance(size, BatchSize)]
    if len(batch_axes) > 1:
        BATCH.refuse()
    row_shape = tuple(size.factor if isinstance(size, BatchSize) else operator.index(size) for size in sizes)
    return row_shape, batch_axes[0] if batch_axes else None


def check_order(order: Any) -> None:
    """Raise `RefusedError` if numbers are not to be counted row by row."""
    if order != "C":
        raise RefusedError("E-NUMPY", "the order of an array is 'C' alone: use np.transpose")


@numpy_function()
def reshape(a: Array, shape: Any, order: Any = "C") -> Array:
    """Reshape. The batch axis may be merged with axes behind it, or divided again."""
    sizes = as_list(shape)
    check_order(order)
    row_shape, batch_axis = split_shape(sizes)
    free = [axis for axis, size in enumerate(row_shape) if size == -1]
    if batch_axis is None and a.batch_axis is not None:  # -1 stands for the batch
        batch_axis, free = (free[0], []) if free else (None, [])
    if len(free) > 1 or (a.batch_axis is None) != (batch_axis is None):
        raise RefusedError("E-ROWS", f"a reshape of {a.shape} to {tuple(sizes)} does not keep the rows apart")
    if batch_axis is None or a.batch_axis is None:
        current_builder().check_size([abs(size) for size in row_shape])
        return a.reshaped(row_shape, None)
    # As many numbers of a row lie before the batch axis as before; the batch axis and those behind it share the others.
    before, behind = math.prod(a.row_shape[: a.batch_axis]), math.prod(a.row_shape[a.batch_axis :])
    new = list(row_shape)
    if free:
        side = slice(0, batch_axis) if free[0] < batch_axis else slice(batch_axis, None)
        size = math.prod(size for size in new[side] if size != -1)
        new[free[0]] = (before if free[0] < batch_axis else behind) // max(size, 1)
    elif not isinstance(sizes[batch_axis], BatchSize):
        new[batch_axis] = behind // max(math.prod(new[batch_axis + 1 :]), 1)
    if math.prod(new[:batch_axis]) != before or math.prod(new[batch_axis:]) != behind or min(new) < 1:
        raise RefusedError("E-ROWS", f"a reshape of {a.shape} to {tuple(sizes)} does not keep the rows apart")
    return a.reshaped(new, batch_axis)


@numpy_function()
def transpose(a: Array, axes: Any = None) -> Array:
    order = list(range(a.ndim))[::-1] if axes is None else [a.axis(axis) for axis in axes]
    if sorted(order) != list(range(a.ndim)):
        raise ValueError(f"axes {axes} do not match an array of the shape {a.shape}")
    return a.transposed(order)


@numpy_function()
def swapaxes(a: Array, axis1: int, axis2: int) -> Array:
    order, first, second = list(range(a.ndim)), a.axis(axis1), a.axis(axis2)
    order[first], order[second] = order[second], order[first]
    return a.transposed(order)


@numpy_function()
def moveaxis(a: Array, source: Any, destination: Any) -> Array:
    moved = [a.axis(axis) for axis in as_list(source)]
    order = [axis for axis in range(a.ndim) if axis not in moved]
    for target, axis in sorted(zip(map(a.axis, as_list(destination)), moved, strict=True)):
        order.insert(target, axis)
    return a.transposed(order)


@numpy_function()
def rollaxis(a: Array, axis: int, start: int = 0) -> Array:
    order = [i for i in range(a.ndim) if i != a.axis(axis)]
    order.insert(start - (a.axis(axis) < start), a.axis(axis))
    return a.transposed(order)


@numpy_function()
def expand_dims(a: Array, axis: Any) -> Any:
    axes = as_list(axis)
    for at in sorted(a.axis(i, extra=len(axes)) for i in axes):
        a = a.select(at, None)
    return a


@numpy_function()
def squeeze(a: Array, axis: Any = None) -> Any:
    single = [i for i, size in enumerate(a.row_shape) if size == 1 and i != a.batch_axis]
    removed = single if axis is None else list(map(a.axis, as_list(axis)))
    if not set(removed) <= set(single):
        raise ValueError(f"an axis of {a.shape} whose length is not 1 cannot be removed")
    return a[tuple(0 if i in removed else ALL for i in range(a.ndim))]


def atleast_1d(a: Array) -> Any:
    return a if a.ndim else a[None]


def atleast_2d(a: Array) -> Any:
    return a if a.ndim > 1 else a[(None,) * (2 - a.ndim)]


def atleast_3d(a: Array) -> Any:
    return a if a.ndim > 2 else atleast_2d(a)[:, :, None]


def _map(function: Callable[[Array], Any], arrays: Sequence[Array]) -> Any:
    """Return the result of a function for one array, or a list of its results for several."""
    results = [function(a) for a in arrays]
    return results[0] if len(results) == 1 else results


@numpy_function()
def broadcast_arrays(*args: Array) -> list[Array]:
    shape, batch_axis = np.broadcast_shapes(*(a.row_shape for a in args)), common_batch_axis(args)
    return [broadcast(a, shape, batch_axis) for a in args]


@numpy_function()
def resize(a: Array, new_shape: Any) -> Array:
    row_shape, _ = split_shape(new_shape)
    current_builder().check_size(row_shape)
    a.row_axes(None)
    return a.rearranged(lambda positions: np.resize(positions, row_shape), None)


@numpy_function()
def size(a: Array, axis: Any = None) -> Any:
    if axis is not None:
        return a.shape[a.axis(axis)]
    numbers = math.prod(a.row_shape)
    return numbers if a.batch_axis is None else BatchSize(numbers)


def ravel(a: Array, order: Any = "C") -> Array:
    return reshape(a, -1, order)


numpy_functions(
    {
        "broadcast_to": lambda array, shape: broadcast(as_array(array), *split_shape(shape)),
        "broadcast_shapes": lambda *args: broadcast_arrays(*(FUNCTIONS["zeros"](shape) for shape in args))[0].shape,
    }
)
array_functions(
    {
        "atleast_1d": lambda *arys: _map(atleast_1d, arys),
        "atleast_2d": lambda *arys: _map(atleast_2d, arys),
        "atleast_3d": lambda *arys: _map(atleast_3d, arys),
        "ravel": ravel,
        "permute_dims": lambda a, axes=None: transpose(a, axes),
        "matrix_transpose linalg.matrix_transpose": lambda x: swapaxes(x, -1, -2),
        "shape": lambda a: a.shape,
        "ndim": lambda a: a.ndim,
    }
)


# --- joining and splitting -------------------------------------------------------------------------------------------


@numpy_function("concatenate", "concat")
def concatenate_(arrays: list[Array], axis: Any = 0) -> Array:
    return concatenate(arrays, axis) if axis is not None else concatenate([ravel(a) for a in arrays], 0)


@numpy_function()
def hstack(tup: list[Array]) -> Array:
    arrays = [atleast_1d(a) for a in tup]
    return concatenate(arrays, 0 if arrays[0].ndim == 1 else 1)


@numpy_function()
def column_stack(tup: list[Array]) -> Array:
    return concatenate([a if a.ndim > 1 else a[:, None] for a in tup], 1)


@numpy_function()
def block(arrays: Any) -> Array:
    """Nested lists of arrays, joined along the last axes."""

    def depth(x: Any) -> int:
        return 1 + max(map(depth, x)) if isinstance(x, list) else 0

    def join(x: Any, axis: int) -> Array:
        return concatenate([join(item, axis + 1) for item in x], axis) if isinstance(x, list) else as_array(x)

    return join(arrays, -depth(arrays))


@numpy_function()
def array_split(ary: Array, indices_or_sections: Any, axis: int = 0) -> list[Any]:
    (at,) = ary.row_axes(axis)
    size = ary.row_shape[at]
    if isinstance(indices_or_sections, (list, tuple, Array)):
        ends = [0, *(operator.index(end) for end in indices_or_sections), size]
    else:
        count = operator.index(indices_or_sections)
        if not 1 <= count <= size:
            raise ValueError(f"{size} numbers cannot be split into {count} parts")
        lengths = [size // count + (i < size % count) for i in range(count)]
        ends = [0, *itertools.accumulate(lengths)]
    return [ary.select(at, slice(start, end)) for start, end in itertools.pairwise(ends)]


@numpy_variants(
    {
        "split": lambda a, axis: axis,
        "hsplit": lambda a, _: min(a.ndim - 1, 1),
        "vsplit": lambda a, _: 0,
        "dsplit": lambda a, _: 2,
    }
)
def split(axis_for: Callable[[Array, int], int], ary: Array, indices_or_sections: Any, axis: int = 0) -> list[Any]:
    at = axis_for(ary, axis)
    size = ary.row_shape[ary.axis(at)]
    if isinstance(indices_or_sections, int) and size % max(indices_or_sections, 1):
        raise ValueError(f"{size} numbers cannot be split into {indices_or_sections} equal parts")
    return array_split(ary, indices_or_sections, at)


@numpy_function()
def unstack(x: Array, *, axis: int = 0) -> tuple[Any, ...]:
    (at,) = x.row_axes(axis)
    return tuple(x.select(at, i) for i in range(x.row_shape[at]))


numpy_functions(
    {
        "stack": lambda arrays, axis=0: stack(as_arrays(arrays), operator.index(axis)),
        "vstack row_stack": lambda tup: concatenate([atleast_2d(a) for a in as_arrays(tup)], 0),
        "dstack": lambda tup: concatenate([atleast_3d(a) for a in as_arrays(tup)], 2),
        "append": lambda arr, values, axis=None: concatenate_([as_array(arr), as_array(values)], axis),
    }
)


@numpy_function()
def delete(arr: Array, obj: Any, axis: Any = None) -> Any:
    at = arr.row_axes(0 if axis is None and arr.ndim == 1 else axis)[0]
    removed = np.arange(arr.row_shape[at])[
        obj if isinstance(obj, (slice, int)) else require_constant(obj, "the index of np.delete")
    ]
    rest = np.setdiff1d(np.arange(arr.row_shape[at]), removed)
    return arr.select(at, as_array(rest) if len(rest) else slice(0, 0))


@numpy_function()
def insert(arr: Array, obj: int, values: Any, axis: Any = None) -> Any:
    at = arr.row_axes(0 if axis is None and arr.ndim == 1 else axis)[0]
    size = arr.row_shape[at]
    i = range(size)[obj] if obj < 0 else range(size + 1)[obj]
    values = broadcast(as_array(values), (*arr.row_shape[:at], 1, *arr.row_shape[at + 1 :]), arr.batch_axis)
    ends = [arr.select(at, end) for end in (slice(None, i), slice(i, None)) if len(range(arr.row_shape[at])[end])]
    return concatenate([*ends[: i > 0], values, *ends[i > 0 :]], at)
