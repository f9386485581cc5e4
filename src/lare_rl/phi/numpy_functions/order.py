"""Functions of the order of numbers: sort, rank, quantiles."""

from __future__ import annotations

import math
from typing import Any

from lare_rl.phi.arrays import Array, elementwise, stack
from lare_rl.phi.indices import ALL
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.reductions import along
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_arrays,
    as_numbers,
    numpy_function,
    require_constant,
)
from lare_rl.phi.numpy_functions.sequences import scan

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
            a, elementwise("divide", q, 100.0), axis, method=method, keepdims=keepdims
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
    """Between the two entries of the sorted numbers at (n - 1) q; NaN if one of the numbers is NaN."""
    fractions = require_constant(q, "q of np.quantile")
    axes = a.row_axes(axis)
    x = as_numbers(a)
    if len(axes) != 1:
        rest = [i for i in range(a.ndim) if i not in axes]
        shape = [a.row_shape[i] for i in rest]
        batch_axis = None if a.batch_axis is None else rest.index(a.batch_axis)
        moved = x.rearranged(lambda p: p.transpose([*rest, *axes]).reshape([*shape, -1]), batch_axis)
        at, x = moved.ndim - 1, moved
    else:
        at = axes[0]
    ordered, is_nan = scan("sort", x, at), along("any", elementwise("isnan", x), at)
    if ((fractions < 0) | (fractions > 1)).any():
        raise ValueError("quantiles are between 0 and 1, percentiles between 0 and 100")
    results = [
        elementwise("where", is_nan, math.nan, _at_fraction(ordered, at, float(fraction), str(method)))
        for fraction in fractions.ravel()
    ]
    if keepdims:
        full_shape = tuple(1 if i in axes else size for i, size in enumerate(a.row_shape))
        results = [result.reshaped(full_shape, a.batch_axis) for result in results]
    return results[0] if not fractions.ndim else stack(results, 0)


def _at_fraction(ordered: Array, at: int, fraction: float, method: str) -> Any:
    position = fraction * (ordered.row_shape[at] - 1)
    low, high = (ordered[(*(ALL,) * at, i)] for i in (math.floor(position), math.ceil(position)))
    weights = {
        "linear": position - math.floor(position), "lower": 0.0, "higher": 1.0, "midpoint": 0.5,
        "nearest": float(round(position) - math.floor(position)),
    }  # fmt: skip
    if method not in weights:
        raise RefusedError("E-NUMPY", f"method={method[:40]!r}: use one of {', '.join(weights)}")
    weight = weights[method]
    return {0.0: low, 1.0: high}.get(weight, elementwise("add", low, (high - low) * weight))
