"""Functions that reduce axes: sums, extremes, means and variances, also without NaN."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, broadcast, elementwise
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import ELEMENTWISE
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, array_functions, as_numbers, numpy_function, numpy_variants

REDUCTIONS: dict[str, tuple[str, Any]] = {
    "sum": ("add", 0), "prod": ("multiply", 1), "max": ("maximum", None), "min": ("minimum", None),
    "any": ("logical_or", False), "all": ("logical_and", True),
}  # fmt: skip
"""For each reduction, the function that it repeats, and what an entry counts as that `where=` leaves out, if anything."""


def along(op: str, x: Array, axis: Any, keepdims: Any = False) -> Array:
    """Apply a reduction along one axis, several axes, or all axes (None)."""
    axes = x.row_axes(axis)
    if op.startswith("arg") and len(axes) != 1:
        x, axes = flatten_constant(x), (0,)
    builder = current_builder()
    reduced = builder.reduce(op, x.node, axes)
    if keepdims:
        reduced = builder.reshape(reduced, tuple(1 if i in axes else size for i, size in enumerate(x.row_shape)))
        return Array(reduced, x.batch_axis)
    return Array(reduced, None if x.batch_axis is None else x.batch_axis - sum(i < x.batch_axis for i in axes))


def flatten_constant(x: Array) -> Array:
    """Return all numbers of a constant in one axis."""
    x.row_axes(None)
    return x.reshaped((-1,), None)


@numpy_variants(
    {"sum": "sum", "prod product": "prod", "max amax": "max", "min amin": "min", "any": "any", "all": "all"}
)
def reduce(
    op: str, a: Array, axis: Any = None, *, keepdims: Any = False, initial: Any = None, where: Any = True
) -> Any:
    ufunc, neutral = REDUCTIONS[op]
    if where is not True:
        if initial is None and neutral is None:
            raise RefusedError("E-NUMPY", f"np.{op} with where= needs initial=")
        a = elementwise("where", where, a, initial if neutral is None else neutral)
    result = along(op, a, axis, keepdims)
    return result if initial is None else elementwise(ufunc, result, initial)


def _count(x: Array, axis: Any, keepdims: Any, where: Any = True) -> Any:
    """Return how many numbers a reduction reads."""
    if where is True:
        return math.prod(x.row_shape[i] for i in x.row_axes(axis))
    return along("sum", broadcast(as_array(where), x.shape), axis, keepdims)


def _sum(x: Any, axis: Any, keepdims: Any, where: Any = True) -> Any:
    return along("sum", as_array(x if where is True else elementwise("where", where, x, 0)), axis, keepdims)


@numpy_function()
def mean(a: Array, axis: Any = None, *, keepdims: Any = False, where: Any = True) -> Any:
    return _sum(as_numbers(a), axis, keepdims, where) / _count(a, axis, keepdims, where)


@numpy_function()
def average(a: Array, axis: Any = None, weights: Any = None, *, keepdims: Any = False) -> Any:
    if weights is None:
        return mean(a, axis, keepdims=keepdims)
    weights = as_numbers(weights)
    if weights.ndim == 1 and a.ndim > 1 and axis is not None and weights.batch_axis is None:
        weights = weights[(..., *(None,) * (a.ndim - 1 - a.axis(axis)))]
    if weights.batch_axis is None or a.batch_axis is not None:
        weights = broadcast(weights, a.shape)
    return _sum(a * weights, axis, keepdims) / _sum(weights, axis, keepdims)


@numpy_variants({"var": False, "std": True})
def var_or_std(
    is_std: bool,
    a: Array,
    axis: Any = None,
    *,
    ddof: Any = 0,
    keepdims: Any = False,
    where: Any = True,
    mean: Any = None,
    correction: Any = None,
) -> Any:
    center = FUNCTIONS["mean"](a, axis, keepdims=True, where=where) if mean is None else mean
    deviation = as_numbers(a) - center
    total = _sum(deviation * deviation, axis, keepdims, where)
    variance = total / elementwise("maximum", _count(a, axis, keepdims, where) - (correction or ddof), 0)
    return elementwise("sqrt", variance) if is_std else variance


SUBSTITUTES = {"sum": 0, "prod": 1, "max": -math.inf, "min": math.inf, "argmax": -math.inf, "argmin": math.inf}


@numpy_variants({f"nan{op}": op for op in SUBSTITUTES})
def reduce_without_nan(op: str, a: Array, axis: Any = None, *, keepdims: Any = False) -> Any:
    if a.kind != "float":
        return along(op, a, axis, keepdims)
    is_nan = elementwise("isnan", a)
    result = along(op, elementwise("where", is_nan, SUBSTITUTES[op], a), axis, keepdims)
    if op in ("max", "min"):  # NaN if nothing else is there
        return elementwise("where", along("all", is_nan, axis, keepdims), math.nan, result)
    return result


@numpy_variants({f"nan{name}": name for name in ("mean", "var", "std")})
def moment_without_nan(name: str, a: Array, axis: Any = None, *, keepdims: Any = False, **more: Any) -> Any:
    is_nan = elementwise("isnan", a)
    return FUNCTIONS[name](elementwise("where", is_nan, 0, a), axis, keepdims=keepdims, where=~is_nan, **more)


array_functions(
    {
        "argmax": lambda a, axis=None, *, keepdims=False: along("argmax", a, axis, keepdims),
        "argmin": lambda a, axis=None, *, keepdims=False: along("argmin", a, axis, keepdims),
        "count_nonzero": lambda a, axis=None, *, keepdims=False: along(
            "sum", elementwise("not_equal", a, 0), axis, keepdims
        ),
        "ptp": lambda a, axis=None, *, keepdims=False: elementwise(
            "subtract", along("max", a, axis, keepdims), along("min", a, axis, keepdims)
        ),
    }
)
BINARY = [op for op in ELEMENTWISE if getattr(np, op).nin == 2]


@numpy_variants({f"{ufunc}.reduce": ufunc for ufunc in BINARY})
def reduce_by(
    ufunc: str, array: Array, axis: Any = 0, keepdims: Any = False, initial: Any = None, where: Any = True
) -> Any:
    for op, (repeated, _) in REDUCTIONS.items():
        if repeated == ufunc:
            return reduce(op, array, axis, keepdims=keepdims, initial=initial, where=where)
    if initial is not None or where is not True:
        raise RefusedError("E-NUMPY", f"np.{ufunc}.reduce has no initial= and no where=: use np.where first")
    if ufunc in ("fmax", "fmin"):
        return reduce_without_nan(ufunc[1:], array, axis, keepdims=keepdims)
    for at in reversed(array.row_axes(axis)):
        slices = [array.select(at, slice(i, i + 1) if keepdims else i) for i in range(array.row_shape[at])]
        array = functools.reduce(lambda x, y: elementwise(ufunc, x, y), slices)
    return +array


@numpy_variants({f"{ufunc}.outer": ufunc for ufunc in BINARY})
def outer(ufunc: str, a: Array, b: Array) -> Any:
    return elementwise(ufunc, a[(..., *(None,) * b.ndim)], b)
