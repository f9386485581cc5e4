"""Functions that move, repeat, read and write numbers at positions."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import all_positions
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_list,
    as_sizes,
    numpy_function,
    numpy_functions,
    require_constant,
)
from lare_rl.phi.numpy_functions.shapes import ravel, split_shape
from lare_rl.phi.operand import BATCH, BatchSize


def flip(m: Array, axis: Any = None) -> Array:
    axes = m.row_axes(axis)
    return m.rearranged(lambda positions: np.flip(positions, axes), m.batch_axis)


@numpy_function()
def rot90(m: Array, k: int = 1, axes: Any = (0, 1)) -> Array:
    first, second = m.axis(axes[0]), m.axis(axes[1])
    m.row_axes((first, second))
    return m.rearranged(lambda positions: np.rot90(positions, k, (first, second)), m.batch_axis)


@numpy_function()
def roll(a: Array, shift: Any, axis: Any = None) -> Array:
    a.row_axes(axis)
    shifts = as_sizes(shift)
    if len(shifts) > 4:
        raise RefusedError("E-COST", "np.roll along more than 4 axes")
    if axis is None:
        return a.rearranged(lambda positions: np.roll(positions, shifts[0]), a.batch_axis)
    at = list(map(a.axis, as_list(axis)))
    amount = shifts if len(shifts) > 1 else shifts[0]
    return a.rearranged(lambda positions: np.roll(positions, amount, at), a.batch_axis)


@numpy_function()
def repeat(a: Array, repeats: Any, axis: Any = None) -> Array:
    """Repeat each number. Along the batch axis, the repetitions of a row stay together."""
    at = a.axis(axis) if axis is not None else a.row_axes(None)[0] if a.ndim == 1 else None
    if isinstance(repeats, BatchSize):
        if at is None or a.batch_axis is not None or a.row_shape[at] != 1:
            BATCH.refuse()
        return Array(a.node, at)
    times = require_constant(repeats, "the repetitions of np.repeat")
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
        raise RefusedError("E-ROWS", "np.tile cannot repeat the batch: use np.repeat along axis 1")
    current_builder().check_size([size * count for size, count in zip(a.row_shape, counts, strict=True)])
    return a.rearranged(lambda positions: np.tile(positions, counts), a.batch_axis)


@numpy_function()
def pad(array: Array, pad_width: Any, mode: Any = "constant", *, constant_values: Any = 0) -> Array:
    widths = np.broadcast_to(require_constant(pad_width, "the widths of np.pad"), (array.ndim, 2)).tolist()
    if array.batch_axis is not None and widths[array.batch_axis] != [0, 0]:
        raise RefusedError("E-ROWS", "np.pad cannot add rows to the batch: write ((0, 0), (before, after))")
    current_builder().check_size([n + sum(map(abs, pair)) for n, pair in zip(array.row_shape, widths, strict=True)])
    if mode in ("edge", "reflect", "symmetric", "wrap"):
        return array.rearranged(lambda positions: np.pad(positions, widths, mode), array.batch_axis)
    if mode != "constant":
        raise RefusedError(
            "E-NUMPY", f"np.pad, mode={str(mode)[:40]!r}: use constant, edge, reflect, symmetric or wrap"
        )
    builder = current_builder()
    fill = as_array(constant_values)
    positions = np.pad(all_positions(array.row_shape), widths, constant_values=math.prod(array.row_shape))
    node = builder.gather(builder.concat([array.node, builder.constant([fill.number()])]), positions)
    return Array(node, array.batch_axis)


@numpy_function()
def take(a: Array, indices: Any, axis: Any = None, mode: Any = "raise") -> Any:
    a, at = (ravel(a), 0) if axis is None else (a, a.axis(axis))
    index = indices if isinstance(indices, int) else as_array(indices)
    if mode in ("clip", "wrap"):
        size = a.row_shape[at]
        index = FUNCTIONS["clip"](as_array(index), 0, size - 1) if mode == "clip" else as_array(index) % size
    return a.select(at, index)


def _along_axis(arr: Array, indices: Array, axis: Any) -> tuple[Any, ...]:
    """Return the index of take_along_axis: `indices` along the axis, and all positions along the others."""
    (at,) = arr.row_axes(axis)
    if indices.ndim != arr.ndim:
        raise ValueError(f"the indices {indices.shape} must have as many axes as the array {arr.shape}")
    return tuple(
        indices if i == at else FUNCTIONS["arange"](size)[(*(None,) * i, ALL, *(None,) * (arr.ndim - i - 1))]
        for i, size in enumerate(arr.shape)
    )


@numpy_function()
def copyto(dst: Array, src: Any, casting: Any = "same_kind", where: Any = True) -> None:
    dst[...] = src if where is True else elementwise("where", where, src, dst)


@numpy_function()
def fill_diagonal(a: Array, val: Any) -> None:
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
    axes, sizes = x.row_axes(axis), as_sizes(window_shape)
    if len(sizes) != len(axes) or any(not 1 <= n <= x.row_shape[i] for n, i in zip(sizes, axes, strict=False)):
        raise ValueError(f"a window of the shape {tuple(sizes)} does not fit into the shape {x.shape}")
    current_builder().check_size([*x.row_shape, *sizes])
    windows = np.lib.stride_tricks.sliding_window_view
    return x.rearranged(lambda positions: windows(positions, sizes, axes).copy(), x.batch_axis)


array_functions(
    {
        "flip": flip,
        "fliplr": lambda m: flip(m, 1),
        "flipud": lambda m: flip(m, 0),
        "take_along_axis": lambda arr, indices, axis=-1: arr[_along_axis(arr, indices, axis)],
    }
)
numpy_functions(
    {
        "put_along_axis": lambda arr, indices, values, axis: as_array(arr).__setitem__(
            _along_axis(as_array(arr), as_array(indices), axis), values
        ),
        "putmask place": lambda a, mask, values: copyto(as_array(a), values, where=as_array(mask)),
    }
)
