"""Functions that join, split, insert and delete."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, broadcast, concatenate, stack
from lare_rl.phi.indices import ALL
from lare_rl.phi.numpy_functions.registry import as_arrays, numpy_function, numpy_functions, require_constant
from lare_rl.phi.numpy_functions.shapes import atleast_1d, atleast_2d, atleast_3d, ravel


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
    return [ary[(*(ALL,) * at, slice(start, end))] for start, end in itertools.pairwise(ends)]


def _register_split(name: str, axis_for: Callable[[Array, int], int]) -> None:
    def split(ary: Array, indices_or_sections: Any, axis: int = 0) -> list[Any]:
        at = axis_for(ary, axis)
        size = ary.row_shape[ary.axis(at)]
        if isinstance(indices_or_sections, int) and size % max(indices_or_sections, 1):
            raise ValueError(f"{size} numbers cannot be split into {indices_or_sections} equal parts")
        return array_split(ary, indices_or_sections, at)

    numpy_function(name)(split)


_register_split("split", lambda a, axis: axis)
_register_split("hsplit", lambda a, _: min(a.ndim - 1, 1))
_register_split("vsplit", lambda a, _: 0)
_register_split("dsplit", lambda a, _: 2)


@numpy_function()
def unstack(x: Array, *, axis: int = 0) -> tuple[Any, ...]:
    (at,) = x.row_axes(axis)
    return tuple(x[(*(ALL,) * at, i)] for i in range(x.row_shape[at]))


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
    return arr[(*(ALL,) * at, as_array(rest) if len(rest) else slice(0, 0))]


@numpy_function()
def insert(arr: Array, obj: int, values: Any, axis: Any = None) -> Any:
    at = arr.row_axes(0 if axis is None and arr.ndim == 1 else axis)[0]
    i = range(arr.row_shape[at] + 1)[obj]
    values = broadcast(as_array(values), (*arr.row_shape[:at], 1, *arr.row_shape[at + 1 :]), arr.batch_axis)
    ends = [arr[(*(ALL,) * at, end)] for end in (slice(None, i), slice(i, None)) if len(range(arr.row_shape[at])[end])]
    return concatenate([*ends[: i > 0], values, *ends[i > 0 :]], at)
