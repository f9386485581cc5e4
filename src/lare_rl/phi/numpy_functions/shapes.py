"""Functions that move numbers: shapes, axes, joining, splitting, repeating."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import (
    ALL,
    BATCH,
    Array,
    BatchSize,
    as_array,
    broadcast,
    common_batch_axis,
    concatenate,
    elementwise,
    stack,
)
from lare_rl.phi.graph import Refused, all_positions, current_builder
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, constant_of, numpy_function


def split_shape(shape: Any) -> tuple[tuple[int, ...], int | None]:
    """A shape that a program names, as the shape in the graph, and the batch axis."""
    sizes = list(shape) if isinstance(shape, (list, tuple)) else [shape]
    batch_axes = [axis for axis, size in enumerate(sizes) if isinstance(size, BatchSize)]
    if len(batch_axes) > 1:
        BATCH.refuse()
    row_shape = tuple(size.factor if isinstance(size, BatchSize) else operator.index(size) for size in sizes)
    return row_shape, batch_axes[0] if batch_axes else None


@numpy_function()
def reshape(a: Array, shape: Any, order: Any = "C") -> Array:
    """The numbers in another shape. The batch axis may be merged with axes behind it, or divided again."""
    sizes = list(shape) if isinstance(shape, (list, tuple)) else [shape]
    if order != "C":
        raise Refused("E-NUMPY", "np.reshape in another order than 'C': use np.transpose")
    row_shape, batch_axis = split_shape(sizes)
    free = [axis for axis, size in enumerate(row_shape) if size == -1]
    if batch_axis is None and a.batch_axis is not None:  # -1 stands for the batch
        batch_axis, free = (free[0], []) if free else (None, [])
    if len(free) > 1 or (a.batch_axis is None) != (batch_axis is None):
        raise Refused("E-ROWS", f"a reshape of {a.shape} to {tuple(sizes)} does not keep the rows apart")
    if batch_axis is None or a.batch_axis is None:
        current_builder().check_size([abs(size) for size in row_shape])
        return a.reshaped(row_shape, None)
    # As many numbers of a row lie before the batch axis as before; the batch axis and those behind it share the others.
    before, behind = math.prod(a.row_shape[: a.batch_axis]), math.prod(a.row_shape[a.batch_axis :])
    new = list(row_shape)
    if free:
        side = slice(0, batch_axis) if free[0] < batch_axis else slice(batch_axis, None)
        others = math.prod(size for size in new[side] if size != -1)
        new[free[0]] = (before if free[0] < batch_axis else behind) // max(others, 1)
    elif not isinstance(sizes[batch_axis], BatchSize):
        new[batch_axis] = behind // max(math.prod(new[batch_axis + 1 :]), 1)
    if math.prod(new[:batch_axis]) != before or math.prod(new[batch_axis:]) != behind or min(new) < 1:
        raise Refused("E-ROWS", f"a reshape of {a.shape} to {tuple(sizes)} does not keep the rows apart")
    return a.reshaped(new, batch_axis)


@numpy_function()
def ravel(a: Array, order: Any = "C") -> Array:
    return reshape(a, -1)


@numpy_function()
def transpose(a: Array, axes: Any = None) -> Array:
    order = list(range(a.ndim))[::-1] if axes is None else [a.axis(axis) for axis in axes]
    if sorted(order) != list(range(a.ndim)):
        raise ValueError(f"axes {axes} do not match an array of the shape {a.shape}")
    return a.transposed(order)


@numpy_function()
def permute_dims(a: Array, axes: Any = None) -> Array:
    return transpose(a, axes)


@numpy_function()
def swapaxes(a: Array, axis1: int, axis2: int) -> Array:
    order, first, second = list(range(a.ndim)), a.axis(axis1), a.axis(axis2)
    order[first], order[second] = order[second], order[first]
    return a.transposed(order)


@numpy_function("matrix_transpose", "linalg.matrix_transpose")
def matrix_transpose(x: Array) -> Array:
    return swapaxes(x, -1, -2)


@numpy_function()
def moveaxis(a: Array, source: Any, destination: Any) -> Array:
    sources, destinations = ([x] if isinstance(x, int) else list(x) for x in (source, destination))
    moved = [a.axis(axis) for axis in sources]
    order = [axis for axis in range(a.ndim) if axis not in moved]
    for target, axis in sorted(zip([a.axis(x) for x in destinations], moved, strict=True)):
        order.insert(target, axis)
    return a.transposed(order)


@numpy_function()
def rollaxis(a: Array, axis: int, start: int = 0) -> Array:
    order = [i for i in range(a.ndim) if i != a.axis(axis)]
    order.insert(start - (a.axis(axis) < start), a.axis(axis))
    return a.transposed(order)


@numpy_function()
def expand_dims(a: Array, axis: Any) -> Any:
    for at in (
        sorted(a.axis(i, extra=len(axis)) for i in axis) if isinstance(axis, (tuple, list)) else [a.axis(axis, extra=1)]
    ):
        a = a[(*(ALL,) * at, None)]
    return a


@numpy_function()
def squeeze(a: Array, axis: Any = None) -> Any:
    single = [i for i, size in enumerate(a.row_shape) if size == 1 and i != a.batch_axis]
    removed = single if axis is None else [a.axis(i) for i in ([axis] if isinstance(axis, int) else axis)]
    if not set(removed) <= set(single):
        raise ValueError(f"an axis of {a.shape} whose length is not 1 cannot be removed")
    return a[tuple(0 if i in removed else ALL for i in range(a.ndim))]


@numpy_function()
def atleast_1d(*arys: Array) -> Any:
    return _each(lambda a: a if a.ndim else a[None], arys)


@numpy_function()
def atleast_2d(*arys: Array) -> Any:
    return _each(lambda a: a if a.ndim > 1 else a[(None,) * (2 - a.ndim)], arys)


@numpy_function()
def atleast_3d(*arys: Array) -> Any:
    return _each(lambda a: a if a.ndim > 2 else (a[:, :, None] if a.ndim == 2 else atleast_2d(a)[:, :, None]), arys)


def _each(function: Callable[[Array], Any], arrays: Sequence[Array]) -> Any:
    results = [function(a) for a in arrays]
    return results[0] if len(results) == 1 else results


# --- joining and splitting ----------------------------------------------------------------------------------------------


@numpy_function("concatenate", "concat")
def concatenate_(arrays: list[Array], axis: Any = 0) -> Array:
    return concatenate(arrays, axis) if axis is not None else concatenate([ravel(a) for a in arrays], 0)


@numpy_function("stack")
def stack_(arrays: list[Array], axis: int = 0) -> Array:
    return stack(arrays, axis)


@numpy_function("vstack", "row_stack")
def vstack(tup: list[Array]) -> Array:
    return concatenate([atleast_2d(a) for a in tup], 0)


@numpy_function()
def hstack(tup: list[Array]) -> Array:
    arrays = [atleast_1d(a) for a in tup]
    return concatenate(arrays, 0 if arrays[0].ndim == 1 else 1)


@numpy_function()
def column_stack(tup: list[Array]) -> Array:
    return concatenate([a if a.ndim > 1 else a[:, None] for a in tup], 1)


@numpy_function()
def dstack(tup: list[Array]) -> Array:
    return concatenate([atleast_3d(a) for a in tup], 2)


@numpy_function()
def block(arrays: Any) -> Array:
    """Nested lists of arrays, joined along the last axes."""

    def depth(x: Any) -> int:
        return 1 + max(map(depth, x)) if isinstance(x, list) else 0

    def join(x: Any, axis: int) -> Array:
        return concatenate([join(item, axis + 1) for item in x], axis) if isinstance(x, list) else as_array(x)

    return join(arrays, -depth(arrays))


@numpy_function()
def append(arr: Array, values: Array, axis: Any = None) -> Array:
    return concatenate_([arr, values], axis)


@numpy_function("array_split")
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
    return [ary[(*(ALL,) * at, slice(start, end))] for start, end in itertools.pairwise(ends)]


def _register_split(name: str, axis_of: Callable[[Array], int] | None) -> None:
    def split(ary: Array, indices_or_sections: Any, axis: int = 0) -> list[Any]:
        at = axis if axis_of is None else axis_of(ary)
        if isinstance(indices_or_sections, int) and ary.row_shape[ary.axis(at)] % max(indices_or_sections, 1):
            raise ValueError(
                f"{ary.row_shape[ary.axis(at)]} numbers cannot be split into {indices_or_sections} equal parts"
            )
        return array_split(ary, indices_or_sections, at)

    numpy_function(name)(split)


for _name, _axis_of in {
    "split": None,
    "hsplit": lambda a: min(a.ndim - 1, 1),
    "vsplit": lambda a: 0,
    "dsplit": lambda a: 2,
}.items():
    _register_split(_name, _axis_of)


@numpy_function()
def unstack(x: Array, *, axis: int = 0) -> tuple[Any, ...]:
    (at,) = x.row_axes(axis)
    return tuple(x[(*(ALL,) * at, i)] for i in range(x.row_shape[at]))


@numpy_function()
def delete(arr: Array, obj: Any, axis: Any = None) -> Any:
    at = arr.row_axes(0 if axis is None and arr.ndim == 1 else axis)[0]
    removed = np.arange(arr.row_shape[at])[
        obj if isinstance(obj, (slice, int)) else constant_of(obj, "the index of np.delete")
    ]
    rest = np.setdiff1d(np.arange(arr.row_shape[at]), removed)
    return arr[(*(ALL,) * at, as_array(rest) if len(rest) else slice(0, 0))]


@numpy_function()
def insert(arr: Array, obj: int, values: Any, axis: Any = None) -> Any:
    at = arr.row_axes(0 if axis is None and arr.ndim == 1 else axis)[0]
    i = range(arr.row_shape[at] + 1)[obj]
    values = broadcast(as_array(values), (*arr.row_shape[:at], 1, *arr.row_shape[at + 1 :]), arr.batch_axis)
    ends = [
        arr[(*(ALL,) * at, part)] for part in (slice(None, i), slice(i, None)) if len(range(arr.row_shape[at])[part])
    ]
    return concatenate([*ends[: i > 0], values, *ends[i > 0 :]], at)


# --- order and repetition -----------------------------------------------------------------------------------------------


@numpy_function()
def flip(m: Array, axis: Any = None) -> Array:
    axes = m.row_axes(axis)
    return m.rearranged(lambda positions: np.flip(positions, axes), m.batch_axis)


@numpy_function()
def fliplr(m: Array) -> Array:
    return flip(m, 1)


@numpy_function()
def flipud(m: Array) -> Array:
    return flip(m, 0)


@numpy_function()
def rot90(m: Array, k: int = 1, axes: Any = (0, 1)) -> Array:
    first, second = m.axis(axes[0]), m.axis(axes[1])
    m.row_axes((first, second))
    return m.rearranged(lambda positions: np.rot90(positions, k, (first, second)), m.batch_axis)


@numpy_function()
def roll(a: Array, shift: Any, axis: Any = None) -> Array:
    a.row_axes(axis)
    shifts = [operator.index(s) for s in (shift if isinstance(shift, (tuple, list)) else [shift])]
    if len(shifts) > 4:
        raise Refused("E-COST", "np.roll along more than 4 axes")
    if axis is None:
        return a.rearranged(lambda positions: np.roll(positions, shifts[0]), a.batch_axis)
    at = [a.axis(i) for i in (axis if isinstance(axis, (tuple, list)) else [axis])]
    return a.rearranged(
        lambda positions: np.roll(positions, shifts if len(shifts) > 1 else shifts[0], at), a.batch_axis
    )


@numpy_function()
def repeat(a: Array, repeats: Any, axis: Any = None) -> Array:
    """Each number several times. Repeating along the batch axis makes several rows of each, which stay together."""
    at = a.axis(axis) if axis is not None else a.row_axes(None)[0] if a.ndim == 1 else None
    if isinstance(repeats, BatchSize):
        if at is None or a.batch_axis is not None or a.row_shape[at] != 1:
            BATCH.refuse()
        return Array(a.node, at)
    times = constant_of(repeats, "the repetitions of np.repeat")
    counts = [operator.index(count) for count in times.ravel().tolist()]
    size = math.prod(a.row_shape) if at is None else a.row_shape[at]
    if min(counts) < 0 or len(counts) not in (1, size):
        raise ValueError("np.repeat needs one number of repetitions, or one for each entry, and none below 0")
    length = sum(counts) if len(counts) > 1 else counts[0] * size
    current_builder().check_size([length, math.prod(a.row_shape) // size])
    if at is None:
        a, at = ravel(a), 0
    return a.rearranged(lambda positions: np.repeat(positions, times, at), a.batch_axis)


@numpy_function()
def tile(A: Array, reps: Any) -> Array:  # noqa: N803
    times, batch_axis = split_shape(reps)
    a = A[(*(None,) * (len(times) - A.ndim), ...)]
    assert isinstance(a, Array)
    counts = [1] * (a.ndim - len(times)) + list(times)
    if batch_axis is not None:
        axis = batch_axis + a.ndim - len(times)
        a = repeat(a, BATCH, axis)
    elif a.batch_axis is not None and counts[a.batch_axis] != 1:
        raise Refused("E-ROWS", "np.tile cannot repeat the batch: use np.repeat along axis 1")
    current_builder().check_size([size * count for size, count in zip(a.row_shape, counts, strict=True)])
    return a.rearranged(lambda positions: np.tile(positions, counts), a.batch_axis)


@numpy_function()
def broadcast_to(array: Array, shape: Any) -> Array:
    return broadcast(array, *split_shape(shape))


@numpy_function()
def broadcast_arrays(*args: Array) -> list[Array]:
    shape, batch_axis = np.broadcast_shapes(*(a.row_shape for a in args)), common_batch_axis(args)
    return [broadcast(a, shape, batch_axis) for a in args]


@numpy_function()
def broadcast_shapes(*args: Any) -> tuple[Any, ...]:
    return broadcast_arrays(*(FUNCTIONS["zeros"](shape) for shape in args))[0].shape


@numpy_function()
def resize(a: Array, new_shape: Any) -> Array:
    row_shape, _ = split_shape(new_shape)
    current_builder().check_size(row_shape)
    a.row_axes(None)
    return a.rearranged(lambda positions: np.resize(positions, row_shape), None)


@numpy_function()
def pad(array: Array, pad_width: Any, mode: Any = "constant", *, constant_values: Any = 0) -> Array:
    widths = np.broadcast_to(constant_of(pad_width, "the widths of np.pad"), (array.ndim, 2)).tolist()
    if array.batch_axis is not None and widths[array.batch_axis] != [0, 0]:
        raise Refused("E-ROWS", "np.pad cannot add rows to the batch: write ((0, 0), (before, after))")
    current_builder().check_size(
        [size + sum(map(abs, pair)) for size, pair in zip(array.row_shape, widths, strict=True)]
    )
    if mode in ("edge", "reflect", "symmetric", "wrap"):
        return array.rearranged(lambda positions: np.pad(positions, widths, mode), array.batch_axis)
    if mode != "constant":
        raise Refused("E-NUMPY", f"np.pad with mode={str(mode)[:40]!r}: use constant, edge, reflect, symmetric or wrap")
    builder = current_builder()
    fill = as_array(constant_values)
    positions = np.pad(all_positions(array.row_shape), widths, constant_values=math.prod(array.row_shape))
    node = builder.gather(builder.concat([array.node, builder.constant([fill.number()])]), positions)
    return Array(node, array.batch_axis)


# --- reading and writing at positions -----------------------------------------------------------------------------------


@numpy_function()
def take(a: Array, indices: Any, axis: Any = None, mode: Any = "raise") -> Any:
    a, at = (ravel(a), 0) if axis is None else (a, a.axis(axis))
    index = indices if isinstance(indices, int) else as_array(indices)
    if mode in ("clip", "wrap"):
        size = a.row_shape[at]
        index = FUNCTIONS["clip"](as_array(index), 0, size - 1) if mode == "clip" else as_array(index) % size
    return a[(*(ALL,) * at, index)]


def _along_axis(arr: Array, indices: Array, axis: Any) -> tuple[Any, ...]:
    """The index of take_along_axis: `indices` along the axis, and each other axis's own numbers along the others."""
    (at,) = arr.row_axes(axis)
    if indices.ndim != arr.ndim:
        raise ValueError(f"the indices {indices.shape} must have as many axes as the array {arr.shape}")
    return tuple(
        indices if i == at else FUNCTIONS["arange"](size)[(*(None,) * i, ALL, *(None,) * (arr.ndim - i - 1))]
        for i, size in enumerate(arr.shape)
    )


@numpy_function()
def take_along_axis(arr: Array, indices: Array, axis: Any = -1) -> Any:
    return arr[_along_axis(arr, indices, axis)]


@numpy_function()
def put_along_axis(arr: Array, indices: Array, values: Any, axis: Any) -> None:
    arr[_along_axis(arr, indices, axis)] = values


@numpy_function()
def copyto(dst: Array, src: Any, casting: Any = "same_kind", where: Any = True) -> None:
    dst[...] = src if where is True else elementwise("where", where, src, dst)


@numpy_function("putmask", "place")
def putmask(a: Array, mask: Array, values: Any) -> None:
    copyto(a, values, where=mask)


@numpy_function()
def fill_diagonal(a: Array, val: Any, wrap: Any = False) -> None:
    a.row_axes(None)
    step = sum(math.prod(a.row_shape[i + 1 :]) for i in range(a.ndim))
    a.reshaped((-1,), None)[: a.row_shape[1] ** 2 : step] = val


@numpy_function("diagonal", "linalg.diagonal")
def diagonal(a: Array, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Array:
    axes = a.axis(axis1), a.axis(axis2)
    a.row_axes(axes)
    batch_axis = None if a.batch_axis is None else a.batch_axis - sum(axis < a.batch_axis for axis in axes)
    return a.rearranged(lambda positions: positions.diagonal(offset, *axes), batch_axis)


@numpy_function("sliding_window_view", "lib.stride_tricks.sliding_window_view")
def sliding_window_view(x: Array, window_shape: Any, axis: Any = None) -> Array:
    axes = x.row_axes(axis)
    sizes = [
        operator.index(size) for size in (window_shape if isinstance(window_shape, (tuple, list)) else [window_shape])
    ]
    if len(sizes) != len(axes) or any(not 1 <= n <= x.row_shape[i] for n, i in zip(sizes, axes, strict=False)):
        raise ValueError(f"a window of the shape {tuple(sizes)} does not fit into the shape {x.shape}")
    current_builder().check_size([*x.row_shape, *sizes])
    windows = np.lib.stride_tricks.sliding_window_view
    return x.rearranged(lambda positions: windows(positions, sizes, axes).copy(), x.batch_axis)


@numpy_function()
def shape(a: Array) -> tuple[Any, ...]:
    return a.shape


@numpy_function()
def ndim(a: Array) -> int:
    return a.ndim


@numpy_function()
def size(a: Array, axis: Any = None) -> Any:
    if axis is not None:
        return a.shape[a.axis(axis)]
    numbers = math.prod(a.row_shape)
    return numbers if a.batch_axis is None else BatchSize(numbers)
