"""Functions that make arrays: of constants, of nested lists, of functions."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, broadcast, rearrange, stack
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_float,
    as_list,
    astype,
    dtype_kind,
    numpy_function,
    numpy_functions,
    numpy_variants,
)
from lare_rl.phi.numpy_functions.shapes import meshgrid


@numpy_function()
def array(object: Array, dtype: Any = None, *, copy: Any = True, ndmin: Any = 0) -> Array:  # noqa: A002
    x = asarray(object.copy() if copy else object, dtype)
    return x[(None,) * (ndmin - x.ndim)] if ndmin > x.ndim else x


@numpy_variants({"ascontiguousarray": "c_contiguous", "asfortranarray": "f_contiguous"})
def contiguous(flag: str, a: Array, dtype: Any = None) -> Array:
    """Return an array, or a copy of it if its numbers are not one behind the other."""
    positions, _, two_rows = a.source
    is_contiguous = getattr((positions if two_rows is None else two_rows).flags, flag)
    return asarray(a if is_contiguous else a.copy(), dtype)


@numpy_function("asarray", "asanyarray", "asarray_chkfinite", "require")
def asarray(a: Array, dtype: Any = None, order: Any = None) -> Array:
    return a if dtype is None or dtype_kind(dtype) == a.kind else astype(a, dtype)


@numpy_function()
def fromiter(iter: Array, dtype: Any, count: int = -1) -> Array:  # noqa: A002
    return asarray(iter, dtype)[range(count) if count >= 0 else slice(None)]


@numpy_function()
def full(shape: Any, fill_value: Any, dtype: Any = None) -> Array:
    return asarray(broadcast(as_array(fill_value), as_list(shape)).copy(), dtype)


@numpy_variants({"zeros": 0, "ones": 1, "empty": math.nan})
def fill(value: Any, shape: Any, dtype: Any = "float") -> Array:
    """Fill with a number. `empty` is NaN until the program has written numbers into it."""
    return full(shape, 0 if value != value and dtype_kind(dtype) != "float" else value, dtype)


@numpy_function()
def full_like(a: Array, fill_value: Any, dtype: Any = None, shape: Any = None) -> Array:
    return full(a.shape if shape is None else shape, fill_value, a.kind if dtype is None else dtype)


@numpy_variants({"zeros_like": 0, "ones_like": 1, "empty_like": math.nan})
def fill_like(value: Any, a: Array, dtype: Any = None, shape: Any = None) -> Array:
    return fill(value, a.shape if shape is None else shape, a.kind if dtype is None else dtype)


@numpy_function()
def arange(start: Any, stop: Any = None, step: Any = 1, dtype: Any = None) -> Array:
    start, stop = (0, start) if stop is None else (start, stop)
    if isinstance(stop, BatchSize) and (start, step) == (0, 1):
        return asarray(Array(current_builder().add("row_number", (), (stop.factor,), "int"), 0), dtype)
    first, last, width = (x if isinstance(x, (int, float)) else as_array(x).number() for x in (start, stop, step))
    if not width or not math.isfinite((last - first) / width):
        raise ValueError("np.arange needs finite numbers, and a step that is not 0")
    current_builder().check_size([max(0, math.ceil((last - first) / width))])
    return asarray(as_array(np.arange(first, last, width)), dtype)


@numpy_variants({"linspace": np.linspace, "logspace": np.logspace, "geomspace": np.geomspace})
def spaced_numbers(
    function: Any,
    start: float,
    stop: float,
    num: int = 50,
    endpoint: Any = True,
    base: float | None = None,
    dtype: Any = None,
) -> Array:
    current_builder().check_size([num])
    more = {} if base is None else {"base": base}
    return as_array(function(start, stop, num, bool(endpoint), dtype=dtype_kind(dtype or "float"), **more))


@numpy_variants({"eye": np.eye, "tri": np.tri})
def unit_matrix(function: Any, N: int, M: int | None = None, k: int = 0, dtype: Any = "float") -> Array:  # noqa: N803
    shape = N, N if M is None else M
    current_builder().check_size(shape)
    return astype(function(*shape, k), dtype)


@numpy_function()
def fromfunction(function: Callable[..., Any], shape: list[int], *, dtype: Any = "float") -> Any:
    current_builder().check_size([*shape, len(shape) or 1])
    return function(*(astype(grid, dtype) for grid in np.indices(shape)))


@numpy_function()
def apply_along_axis(func1d: Callable[..., Any], axis: int, arr: Array, *args: Any, **kwargs: Any) -> Any:
    """Apply a function to each series along the last axis. It is called once for each entry of the other axes of a row."""
    (at,) = arr.row_axes(axis)
    if at != arr.ndim - 1:
        raise RefusedError("E-NUMPY", "np.apply_along_axis works along the last axis: use axis=-1")
    series_of_row = Array(arr.node, None).reshaped((-1, arr.row_shape[at]), None)
    results = [as_array(func1d(series, *args, **kwargs)) for series in series_of_row]
    if any(result.batch_axis is not None for result in results):
        raise RefusedError("E-ROWS", "the function of np.apply_along_axis mixes rows: it may only use its own argument")
    results = stack(results, 0)
    return results.reshaped((*arr.row_shape[:-1], *results.row_shape[1:]), arr.batch_axis)


class Indexed:
    """An object of NumPy that makes an array of an index. Slices mean ranges. A grid of a single slice is its range."""

    def __init__(self, join: Callable[[list[Array]], Any], *, is_grid: bool = False):
        self.join, self.is_grid = join, is_grid

    def __getitem__(self, index: Any) -> Any:
        ranges = list(map(_read_range, index if isinstance(index, tuple) else (index,)))
        return ranges[0] if self.is_grid and not isinstance(index, tuple) else self.join(ranges)


def _read_range(item: Any) -> Array:
    if not isinstance(item, slice):
        return as_array(item)
    if isinstance(item.step, complex):  # 5j: five numbers
        return FUNCTIONS["linspace"](as_float(item.start or 0), as_float(item.stop), int(abs(item.step)))
    return arange(item.start or 0, item.stop, 1 if item.step is None else item.step)


INDEXED = {
    "np.r_": Indexed(lambda items: rearrange(lambda arrays: np.r_[tuple(arrays)], items)),
    "np.c_": Indexed(lambda items: rearrange(lambda arrays: np.c_[tuple(arrays)], items)),
    "np.mgrid": Indexed(lambda ranges: stack(meshgrid(*ranges, indexing="ij"), 0), is_grid=True),
    "np.ogrid": Indexed(lambda ranges: meshgrid(*ranges, indexing="ij", sparse=True), is_grid=True),
}
"""Objects of NumPy that are used with an index."""


@numpy_function()
def indices(dimensions: list[int], dtype: Any = "int") -> Array:
    current_builder().check_size([*dimensions, len(dimensions)])
    return astype(np.indices(dimensions), dtype)


array_functions(
    {
        "copy": lambda a: a.copy(),
        "ix_": lambda *args: rearrange(
            lambda arrays: np.ix_(*arrays), [FUNCTIONS["flatnonzero"](a) if a.kind == "bool" else a for a in args]
        ),
    }
)
numpy_functions(
    {
        "astype": astype,
        "identity": lambda n, dtype="float": unit_matrix(np.eye, operator.index(n), dtype=dtype),
    }
)
