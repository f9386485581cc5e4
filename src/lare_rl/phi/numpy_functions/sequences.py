"""Functions along one axis: cumulative sums, differences, gradients, integrals, sorting and quantiles."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, broadcast, concatenate, elementwise, rearrange, stack
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.reductions import along, flatten_constant
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_arrays,
    as_list,
    as_numbers,
    numpy_function,
    numpy_variants,
    require_constant,
)


def scan(op: str, x: Array, axis: Any) -> Array:
    """Apply cumsum, cumprod, sort or argsort along an axis."""
    x = x if axis is not None or x.ndim == 1 else flatten_constant(x)
    (at,) = x.row_axes(0 if axis is None else axis)
    return Array(current_builder().scan(op, x.node, at), x.batch_axis)


array_functions(
    {
        "cumsum cumulative_sum": lambda a, axis=None: scan("cumsum", a, axis),
        "cumprod cumulative_prod": lambda a, axis=None: scan("cumprod", a, axis),
        "nancumsum": lambda a, axis=None: scan("cumsum", elementwise("where", elementwise("isnan", a), 0, a), axis),
        "add.accumulate": lambda array, axis=0: scan("cumsum", array, axis),
        "multiply.accumulate": lambda array, axis=0: scan("cumprod", array, axis),
        "ediff1d": lambda ary: diff(flatten_constant(ary)),
    }
)


@numpy_variants({f"{op}.accumulate": op for op in ("maximum", "minimum", "fmax", "fmin", "logical_and", "logical_or")})
def accumulate(ufunc: str, array: Array, axis: Any = 0) -> Any:
    """By doubling: after k turns, an entry is the result of itself and the 2^k - 1 entries before it."""
    (at,) = array.row_axes(axis)
    size, shift = array.row_shape[at], 1
    while shift < size:
        before = [max(i - shift, 0) for i in range(size)]
        array = elementwise(ufunc, array, array.select(at, before))
        shift *= 2
    return +array


@numpy_function()
def diff(a: Array, n: int = 1, axis: int = -1, prepend: Any = None, append: Any = None) -> Any:
    (at,) = a.row_axes(axis)
    if prepend is not None or append is not None:
        arrays = [as_array(x) for x in (prepend, a, append) if x is not None]
        a = concatenate([x if x.ndim else broadcast(x, (*a.shape[:at], 1, *a.shape[at + 1 :])) for x in arrays], at)
    op = "not_equal" if a.kind == "bool" else "subtract"
    for _ in range(n):
        a = elementwise(op, a.select(at, slice(1, None)), a.select(at, slice(None, -1)))
    return a


@numpy_function()
def gradient(f: Array, *varargs: Any, axis: Any = None, edge_order: int = 1) -> Any:
    """Central differences inside, and one-sided differences at the ends."""
    f.row_axes(axis)  # refuses the batch axis
    axes = range(f.ndim) if axis is None else list(map(f.axis, as_list(axis)))
    spacings = [as_array(x) for x in (varargs if len(varargs) == len(axes) else (varargs or (1.0,)) * len(axes))]
    slopes = []
    for at, spacing in zip(axes, spacings, strict=True):
        slope = _gradient_along_last_axis(rearrange(np.moveaxis, as_numbers(f), at, -1), spacing, edge_order)
        slopes.append(rearrange(np.moveaxis, slope, -1, at))
    return slopes[0] if len(slopes) == 1 else slopes


def _gradient_along_last_axis(f: Array, spacing: Array, edge_order: int) -> Any:
    size = f.row_shape[-1]
    if size < edge_order + 1:
        raise ValueError(f"np.gradient needs at least {edge_order + 1} numbers along its axis")
    x = require_constant(spacing, "the spacing of np.gradient").ravel().astype(float)
    x = np.arange(size) * x[0] if len(x) == 1 else x
    if len(x) != size:
        raise ValueError(f"np.gradient of {size} numbers needs one spacing, or {size} positions")
    pieces = [(f[..., 1:2] - f[..., :1]) / (x[1] - x[0])]
    if size > 2:
        d0, d1 = x[1:-1] - x[:-2], x[2:] - x[1:-1]
        w_before, w_middle, w_behind = -d1 / (d0 * (d0 + d1)), (d1 - d0) / (d0 * d1), d0 / (d1 * (d0 + d1))
        inner = f[..., :-2] * w_before + f[..., 2:] * w_behind
        pieces.append(inner + f[..., 1:-1] * w_middle if w_middle.any() else inner)  # not 0 * inf
    pieces.append((f[..., -1:] - f[..., -2:-1]) / (x[-1] - x[-2]))
    if edge_order == 2:
        for piece, (i, j, k) in ((0, (0, 1, 2)), (-1, (size - 1, size - 2, size - 3))):
            d0, d1 = x[j] - x[i], x[k] - x[j]
            edge, middle, inner = (f[..., [n]] for n in (i, j, k))
            first = edge * (-(2 * d0 + d1) / (d0 * (d0 + d1)))
            pieces[piece] = first + middle * ((d0 + d1) / (d0 * d1)) - inner * (d0 / (d1 * (d0 + d1)))
    return concatenate(pieces, -1)


@numpy_function("trapezoid", "trapz")
def trapezoid(y: Array, x: Any = None, dx: Any = 1.0, axis: int = -1) -> Any:
    (at,) = y.row_axes(axis)
    width = as_array(dx)
    if x is not None:
        x = as_array(x)
        width = diff(x, 1, 0 if x.ndim == 1 else at)
        width = width[(..., *(None,) * (y.ndim - 1 - at))] if x.ndim == 1 and y.ndim > 1 else width
    return along("sum", width * ((y.select(at, slice(1, None)) + y.select(at, slice(None, -1))) / 2.0), at)


# --- the order of numbers --------------------------------------------------------------------------------------------


array_functions(
    {
        "sort": lambda a, axis=-1, kind=None, stable=None: scan("sort", a, axis),
        "argsort": lambda a, axis=-1, kind=None, stable=None: scan("argsort", a, axis),
        # Sorted completely, which every partition allows.
        "partition": lambda a, kth, axis=-1, kind=None: scan("sort", a, axis),
        "argpartition": lambda a, kth, axis=-1, kind=None: scan("argsort", a, axis),
        "median": lambda a, axis=None, *, keepdims=False, overwrite_input=False: quantile(
            a, 0.5, axis, keepdims=keepdims
        ),
        "percentile": lambda a, q, axis=None, *, method="linear", keepdims=False: quantile(
            a, q / 100.0, axis, method=method, keepdims=keepdims
        ),
    }
)


@numpy_function()
def lexsort(keys: Any, axis: int = -1) -> Array:
    """Sort by the last key, then by the one before it, and so on: by the first, then stably by the others."""
    arrays = list(keys) if not isinstance(keys, Array) else [keys[i] for i in range(keys.row_shape[0])]
    order: Any = None
    for key in as_arrays(arrays):
        at = key.axis(axis)
        ordered = key if order is None else FUNCTIONS["take_along_axis"](key, order, at)
        sorted_ = scan("argsort", ordered, at)
        order = sorted_ if order is None else FUNCTIONS["take_along_axis"](order, sorted_, at)
    return order


@numpy_function()
def quantile(a: Array, q: Any, axis: Any = None, *, method: Any = "linear", keepdims: Any = False) -> Any:
    """Interpolate between the two sorted numbers next to the position (n - 1) q; NaN if one of all numbers is NaN."""
    fractions = require_constant(q, "q of np.quantile")
    axes = a.row_axes(axis)
    rest = [i for i in range(a.ndim) if i not in axes]
    x, at = as_numbers(a), len(rest)
    x = rearrange(lambda p: p.transpose([*rest, *axes]).reshape([*(p.shape[i] for i in rest), -1]), x)
    ordered, is_nan = scan("sort", x, at), along("any", elementwise("isnan", x), at)
    if ((fractions < 0) | (fractions > 1)).any():
        raise ValueError("quantiles are between 0 and 1, percentiles between 0 and 100")
    results = [
        elementwise("where", is_nan, math.nan, _at_fraction(ordered, at, float(fraction), str(method)))
        for fraction in fractions.ravel()
    ]
    if keepdims:
        results = [FUNCTIONS["expand_dims"](result, axes) for result in results]
    return results[0] if not fractions.ndim else stack(results, 0)


def _at_fraction(ordered: Array, at: int, fraction: float, method: str) -> Any:
    position = fraction * (ordered.row_shape[at] - 1)
    low, high = (ordered.select(at, i) for i in (math.floor(position), math.ceil(position)))
    weights = {
        "linear": position - math.floor(position), "lower": 0.0, "higher": 1.0, "midpoint": 0.5,
        "nearest": float(round(position) - math.floor(position)),
    }  # fmt: skip
    if method not in weights:
        raise RefusedError("E-NUMPY", f"method={method[:40]!r}: use one of {', '.join(weights)}")
    weight = weights[method]
    if weight == 0.5:
        return (low + high) * 0.5  # the difference of two infinities is NaN
    return {0.0: low, 1.0: high}.get(weight, low + (high - low) * weight)
