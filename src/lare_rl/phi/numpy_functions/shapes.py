"""Functions that move, repeat, join and split numbers: NumPy itself applies them to positions (`arrays.rearrange`).

A function whose result may be larger than its arguments checks its size first.
"""

from __future__ import annotations

import functools
import inspect
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, rearrange
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.builder import current_builder
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.reductions import flatten_constant
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_arrays,
    as_list,
    as_sizes,
    astype,
    numpy_function,
    numpy_functions,
    numpy_variants,
    require_constant,
)
from lare_rl.phi.rearrange import map_leaves


def _register(names: str, convert: Callable[[Any], Any]) -> None:
    """Register a function that moves the numbers of its first argument, without those of its parameters that move nothing."""
    function: Any = functools.reduce(getattr, names.split()[0].split("."), np)

    def apply(moved: Any, *args: Any, **kwargs: Any) -> Any:
        return rearrange(functools.partial(function, **kwargs), convert(moved), *args)

    ignored = ("out", "dtype", "casting", "subok")
    parameters = [p for p in inspect.signature(function).parameters.values() if p.name not in ignored]
    vars(apply)["__signature__"] = inspect.Signature(parameters)
    numpy_function(*names.split())(apply)


# Commas separate functions, spaces the names of one function.
for _names in (
    "transpose permute_dims,matrix_transpose linalg.matrix_transpose,swapaxes,moveaxis,rollaxis,expand_dims,ravel,broadcast_to,"
    "flip,fliplr,flipud,rot90,diagonal,linalg.diagonal,hsplit,vsplit,dsplit"
).split(","):
    _register(_names, as_array)
for _names in ("stack", "hstack", "vstack row_stack", "dstack", "column_stack"):
    _register(_names, as_arrays)


def _rearrange_each(function: Callable[[Any], Any], arrays: Sequence[Array]) -> Any:
    results = tuple(rearrange(function, x) for x in arrays)
    return results[0] if len(results) == 1 else results


numpy_functions(
    {
        "concatenate concat": lambda arrays, axis=0: rearrange(np.concatenate, as_arrays(arrays), axis),
        "append": lambda arr, values, axis=None: rearrange(
            lambda both: np.append(both[0], both[1], axis), [as_array(arr), as_array(values)]
        ),
        "block": lambda arrays: rearrange(np.block, map_leaves(as_array, arrays)),
        "broadcast_shapes": lambda *args: broadcast_arrays(*map(FUNCTIONS["zeros"], args))[0].shape,
    }
)
array_functions(
    {
        "atleast_1d": lambda *arys: _rearrange_each(np.atleast_1d, arys),
        "atleast_2d": lambda *arys: _rearrange_each(np.atleast_2d, arys),
        "atleast_3d": lambda *arys: _rearrange_each(np.atleast_3d, arys),
        "shape": lambda a: a.shape,
        "ndim": lambda a: a.ndim,
        "tril": lambda m, k=0: _with_zeros(np.tril, m, (-1, -2), k),
        "triu": lambda m, k=0: _with_zeros(np.triu, m, (-1, -2), k),
        "diagflat": lambda v, k=0: _diagonal_matrix(rearrange(np.ravel, v), k),
    }
)


@numpy_function()
def reshape(a: Array, shape: Any, order: Any = "C") -> Array:
    return rearrange(np.reshape, a, shape, order)


@numpy_function()
def squeeze(a: Array, axis: Any = None) -> Any:
    single = [i for i, size in enumerate(a.row_shape) if size == 1 and i != a.batch_axis]
    return rearrange(np.squeeze, a, tuple(single) if axis is None else axis)


@numpy_function()
def broadcast_arrays(*args: Array) -> tuple[Array, ...]:
    return rearrange(lambda arrays: np.broadcast_arrays(*arrays), list(args))


@numpy_function()
def size(a: Array, axis: Any = None) -> Any:
    if axis is not None:
        return a.shape[a.axis(axis)]
    numbers = math.prod(a.row_shape)
    return numbers if a.batch_axis is None else BatchSize(numbers)


@numpy_variants({"split": np.split, "array_split": np.array_split})
def split(function: Callable[..., Any], ary: Array, indices_or_sections: Any, axis: int = 0) -> list[Array]:
    current_builder().check_size([max(1, *as_sizes(indices_or_sections))])
    return rearrange(function, ary, indices_or_sections, axis)


@numpy_function()
def unstack(x: Array, *, axis: int = 0) -> list[Array]:
    return rearrange(lambda positions: list(np.moveaxis(positions, axis, 0)), x)


# --- repetitions, and numbers that are added or left out -----------------------------------------------------------------


def _with_zeros(function: Callable[..., Any], a: Array, axes: tuple[int, ...], *args: Any) -> Array:
    """Apply a function of NumPy that moves numbers along `axes`, and fills with zeros."""
    a.row_axes(axes)  # refuses the batch axis
    # Zeros become -1, which `rearrange` takes for a zero.
    return rearrange(lambda positions, *args: function(positions + 1, *args) - 1, a, *args)


def _diagonal_matrix(v: Array, k: Any) -> Array:
    v.row_axes(0)
    current_builder().check_size([v.row_shape[0] + abs(operator.index(k))] * 2)
    return _with_zeros(np.diag, v, (0,), k)


@numpy_function()
def diag(v: Array, k: int = 0) -> Any:
    return FUNCTIONS["diagonal"](v, k) if v.ndim == 2 else _diagonal_matrix(v, k)


@numpy_function()
def roll(a: Array, shift: Any, axis: Any = None) -> Array:
    a.row_axes(axis)
    if len(as_list(shift)) > 4:
        raise RefusedError("E-COST", "np.roll along more than 4 axes")
    return rearrange(np.roll, a, shift, axis)


@numpy_function()
def resize(a: Array, new_shape: list[int]) -> Array:
    current_builder().check_size(new_shape)
    return rearrange(np.resize, a, new_shape)


@numpy_function()
def repeat(a: Array, repeats: Any, axis: Any = None) -> Array:
    """Repeat each number. Along the batch axis, the repetitions of a row stay together."""
    if not isinstance(repeats, BatchSize):
        current_builder().check_size([math.prod(a.row_shape), max(1, *as_sizes(repeats))])
    return rearrange(np.repeat, a, repeats, axis)


@numpy_function()
def tile(A: Array, reps: Any) -> Array:  # noqa: N803
    counts = [count.factor if isinstance(count, BatchSize) else operator.index(count) for count in as_list(reps)]
    current_builder().check_size([math.prod(A.row_shape), *counts])
    return rearrange(np.tile, A, reps)


@numpy_function()
def pad(array: Array, pad_width: Any, mode: Any = "constant", *, constant_values: Any = 0) -> Array:
    widths = np.broadcast_to(require_constant(pad_width, "the widths of np.pad"), (array.ndim, 2)).tolist()
    current_builder().check_size([n + sum(map(abs, pair)) for n, pair in zip(array.row_shape, widths, strict=True)])
    if mode in ("edge", "reflect", "symmetric", "wrap"):
        return rearrange(np.pad, array, widths, mode)
    if mode != "constant":
        text = f"np.pad, mode={str(mode)[:40]!r}: use constant, edge, reflect, symmetric or wrap"
        raise RefusedError("E-NUMPY", text)
    fill = astype(as_array(constant_values).number(), array.kind)
    return rearrange(lambda both: np.pad(both[0], widths, constant_values=both[1]), [array, fill])


def _flatten_without_axis(arr: Array, axis: Any) -> tuple[Array, int]:
    """Return an array and one of its axes; without `axis`, all its numbers in one axis."""
    return (flatten_constant(arr), 0) if axis is None else (arr, arr.row_axes(axis)[0])


@numpy_function()
def delete(arr: Array, obj: Any, axis: Any = None) -> Any:
    arr, at = _flatten_without_axis(arr, axis)
    return rearrange(np.delete, arr, obj, at)


@numpy_function()
def insert(arr: Array, obj: int, values: Array, axis: Any = None) -> Any:
    arr, at = _flatten_without_axis(arr, axis)
    length = arr.row_shape[at]
    current_builder().check_size([math.prod(arr.row_shape) // length, length + math.prod(values.row_shape)])
    return rearrange(lambda both: np.insert(both[0], obj, both[1], at), [arr, astype(values, arr.kind)])


@numpy_function("sliding_window_view", "lib.stride_tricks.sliding_window_view")
def sliding_window_view(x: Array, window_shape: list[int], axis: Any = None) -> Array:
    current_builder().check_size([*x.row_shape, *(max(size, 1) for size in window_shape)])
    return rearrange(
        lambda positions: np.lib.stride_tricks.sliding_window_view(positions, window_shape, axis).copy(), x
    )


@numpy_function()
def meshgrid(*xi: Array, indexing: Any = "xy", sparse: Any = False, copy: Any = True) -> tuple[Array, ...]:
    current_builder().check_size([math.prod(x.row_shape) for x in xi])
    return rearrange(lambda arrays: np.meshgrid(*arrays, indexing=indexing, sparse=bool(sparse)), list(xi))


# --- reading and writing at positions -------------------------------------------------------------------------------------


@numpy_function()
def take(a: Array, indices: Any, axis: Any = None, mode: Any = "raise") -> Any:
    a, at = (rearrange(np.ravel, a), 0) if axis is None else (a, a.axis(axis))
    index = indices if isinstance(indices, int) else as_array(indices)
    if mode in ("clip", "wrap"):
        size = a.row_shape[at]
        index = FUNCTIONS["clip"](as_array(index), 0, size - 1) if mode == "clip" else as_array(index) % size
    return a.select(at, index).copy()


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
    dst[...] = src if where is True else FUNCTIONS["where"](where, src, dst)


@numpy_function()
def fill_diagonal(a: Array, val: Any) -> None:
    a.row_axes(None)  # refuses the batch axis
    if a.ndim < 2 or (a.ndim > 2 and len(set(a.row_shape)) > 1):
        raise ValueError(f"np.fill_diagonal of the shape {a.shape}: use a matrix, or an array with axes of one length")
    a[(list(range(min(a.row_shape))),) * a.ndim] = val


@numpy_variants({"putmask": True, "place": False})
def write_masked(is_aligned: bool, a: Array, mask: Array, values: Array) -> None:
    """Write where a mask is true: a single number; or, if `is_aligned`, each number at the same place as in `values`."""
    is_single = values.batch_axis is None and math.prod(values.row_shape) == 1
    if not is_single and not (is_aligned and values.layout == a.layout):
        raise RefusedError("E-NUMPY", "np.putmask and np.place repeat values: write a[...] = np.where(mask, values, a)")
    copyto(a, values, where=mask)


array_functions({"take_along_axis": lambda arr, indices, axis=-1: arr[_along_axis(arr, indices, axis)]})
numpy_functions(
    {
        "put_along_axis": lambda arr, indices, values, axis: as_array(arr).__setitem__(
            _along_axis(as_array(arr), as_array(indices), axis), values
        ),
    }
)
