"""Functions along axes: sums, extremes, statistics, cumulative sums, differences, order."""

from __future__ import annotations

import functools
import math
from typing import Any

from lare_rl.phi.arrays import ALL, Array, as_array, broadcast, concatenate, elementwise, stack
from lare_rl.phi.graph import ELEMENTWISE, Refused, current_builder
from lare_rl.phi.numpy_functions.elementwise import UNARY, power
from lare_rl.phi.numpy_functions.registry import FUNCTIONS, as_arrays, as_numbers, constant_of, numpy_function

UFUNC_REDUCTIONS = {
    "add": "sum", "multiply": "prod", "maximum": "max", "minimum": "min", "logical_and": "all", "logical_or": "any",
    "fmax": "nanmax", "fmin": "nanmin",
}  # fmt: skip
NEUTRAL: dict[str, Any] = {"sum": 0, "prod": 1, "any": False, "all": True}
"""What the entries that `where=` leaves out count as."""


def along(op: str, x: Array, axis: Any, keepdims: Any = False) -> Array:
    """An operation along axes: one, several, or all for None."""
    axes = x.row_axes(axis)
    if op.startswith("arg") and len(axes) != 1:
        x, axes = _flat(x), (0,)
    builder, node = current_builder(), x.node
    reduced = builder.reduce(op, node, axes)
    if keepdims:
        reduced = builder.reshape(reduced, tuple(1 if i in axes else size for i, size in enumerate(x.row_shape)))
        return Array(reduced, x.batch_axis)
    return Array(reduced, None if x.batch_axis is None else x.batch_axis - sum(i < x.batch_axis for i in axes))


def _flat(x: Array) -> Array:
    """All numbers of a constant in one axis."""
    x.row_axes(None)
    return x.reshaped((-1,), None)


def _register_reduction(name: str, op: str, *aliases: str) -> None:
    def reduce(a: Array, axis: Any = None, *, keepdims: Any = False, initial: Any = None, where: Any = True) -> Any:
        if where is not True:
            if initial is None and op not in NEUTRAL:
                raise Refused("E-NUMPY", f"np.{op} with where= needs initial=")
            a = elementwise("where", where, a, NEUTRAL.get(op, initial))
        result = along(op, a, axis, keepdims)
        if initial is not None:
            joined = {reduction: ufunc for ufunc, reduction in UFUNC_REDUCTIONS.items()}[op]
            result = elementwise(joined, result, initial)
        return result

    numpy_function(name, *aliases)(reduce)


for _op in ("sum", "prod", "max", "min", "any", "all"):
    _register_reduction(_op, _op, *{"max": ["amax"], "min": ["amin"], "prod": ["product"]}.get(_op, []))


@numpy_function()
def argmax(a: Array, axis: Any = None, *, keepdims: Any = False) -> Array:
    return along("argmax", a, axis, keepdims)


@numpy_function()
def argmin(a: Array, axis: Any = None, *, keepdims: Any = False) -> Array:
    return along("argmin", a, axis, keepdims)


def _count(x: Array, axis: Any, keepdims: Any, where: Any = True) -> Any:
    """How many numbers a reduction reads."""
    if where is True:
        return math.prod(x.row_shape[i] for i in x.row_axes(axis))
    return along("sum", broadcast(as_array(where), x.row_shape, x.batch_axis), axis, keepdims)


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
    weights = broadcast(weights, a.row_shape, a.batch_axis) if a.batch_axis is not None else weights
    return _sum(a * weights, axis, keepdims) / _sum(weights, axis, keepdims)


def _register_spread(name: str, has_root: bool) -> None:
    def spread(
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
        deviation = elementwise("subtract", as_numbers(a), center)
        total = _sum(elementwise("multiply", deviation, deviation), axis, keepdims, where)
        variance = total / (_count(a, axis, keepdims, where) - (correction or ddof))
        return elementwise("sqrt", variance) if has_root else variance

    numpy_function(name)(spread)


_register_spread("var", has_root=False)
_register_spread("std", has_root=True)


@numpy_function()
def ptp(a: Array, axis: Any = None, *, keepdims: Any = False) -> Any:
    return elementwise("subtract", along("max", a, axis, keepdims), along("min", a, axis, keepdims))


@numpy_function()
def count_nonzero(a: Array, axis: Any = None, *, keepdims: Any = False) -> Array:
    return along("sum", elementwise("not_equal", a, 0), axis, keepdims)


# --- without NaN --------------------------------------------------------------------------------------------------------


def _register_without_nan(name: str, substitute: int | float) -> None:
    def reduce(a: Array, axis: Any = None, *, keepdims: Any = False) -> Any:
        is_nan = elementwise("isnan", a)
        result = along(name, elementwise("where", is_nan, substitute, a), axis, keepdims)
        if name in ("max", "min"):  # NaN if nothing else is there
            return elementwise("where", along("all", is_nan, axis, keepdims), math.nan, result)
        return result

    numpy_function(f"nan{name}")(reduce)


for _name, _substitute in {
    "sum": 0,
    "prod": 1,
    "max": -math.inf,
    "min": math.inf,
    "argmax": -math.inf,
    "argmin": math.inf,
}.items():
    _register_without_nan(_name, _substitute)


@numpy_function()
def nanmean(a: Array, axis: Any = None, *, keepdims: Any = False) -> Any:
    return mean(elementwise("where", elementwise("isnan", a), 0, a), axis, keepdims=keepdims, where=_not_nan(a))


@numpy_function()
def nanvar(a: Array, axis: Any = None, *, ddof: Any = 0, keepdims: Any = False) -> Any:
    a, where = elementwise("where", elementwise("isnan", a), 0, a), _not_nan(a)
    return FUNCTIONS["var"](a, axis, ddof=ddof, keepdims=keepdims, where=where)


@numpy_function()
def nanstd(a: Array, axis: Any = None, *, ddof: Any = 0, keepdims: Any = False) -> Any:
    return elementwise("sqrt", nanvar(a, axis, ddof=ddof, keepdims=keepdims))


def _not_nan(a: Array) -> Any:
    return elementwise("logical_not", elementwise("isnan", a))


# --- cumulative ---------------------------------------------------------------------------------------------------------


def _scan(op: str, x: Array, axis: Any) -> Array:
    x = x if axis is not None or x.ndim == 1 else _flat(x)
    (at,) = x.row_axes(0 if axis is None else axis)
    return Array(current_builder().scan(op, x.node, at), x.batch_axis)


@numpy_function("cumsum", "cumulative_sum")
def cumsum(a: Array, axis: Any = None) -> Array:
    return _scan("cumsum", a, axis)


@numpy_function("cumprod", "cumulative_prod")
def cumprod(a: Array, axis: Any = None) -> Array:
    return _scan("cumprod", a, axis)


@numpy_function()
def nancumsum(a: Array, axis: Any = None) -> Array:
    return _scan("cumsum", elementwise("where", elementwise("isnan", a), 0, a), axis)


def _register_accumulation(ufunc: str) -> None:
    """maximum.accumulate and its like, by doubling: after k turns, an entry knows the 2^k before it."""

    def accumulate(array: Array, axis: Any = 0) -> Any:
        (at,) = array.row_axes(axis)
        size, shift = array.row_shape[at], 1
        while shift < size:
            before = [max(i - shift, 0) for i in range(size)]
            array = elementwise(ufunc, array, array[(*(ALL,) * at, before)])
            shift *= 2
        return array

    numpy_function(f"{ufunc}.accumulate")(accumulate)


for _ufunc in ("maximum", "minimum", "fmax", "fmin", "logical_and", "logical_or"):
    _register_accumulation(_ufunc)


@numpy_function("add.accumulate")
def _add_accumulate(array: Array, axis: Any = 0) -> Array:
    return _scan("cumsum", array, axis)


@numpy_function("multiply.accumulate")
def _multiply_accumulate(array: Array, axis: Any = 0) -> Array:
    return _scan("cumprod", array, axis)


def _register_ufunc_methods(ufunc: str) -> None:
    """ufunc.reduce and ufunc.outer."""

    def reduce(array: Array, axis: Any = 0, keepdims: Any = False, initial: Any = None, where: Any = True) -> Any:
        if ufunc in UFUNC_REDUCTIONS:
            more = {"initial": initial, "where": where} if initial is not None or where is not True else {}
            return FUNCTIONS[UFUNC_REDUCTIONS[ufunc]](array, axis, keepdims=keepdims, **more)
        for at in reversed(array.row_axes(axis)):
            slices = [array[(*(ALL,) * at, slice(i, i + 1) if keepdims else i)] for i in range(array.row_shape[at])]
            array = functools.reduce(lambda x, y: elementwise(ufunc, x, y), slices)
        return array

    def outer(a: Array, b: Array) -> Any:
        return elementwise(ufunc, a[(..., *(None,) * b.ndim)], b)

    numpy_function(f"{ufunc}.reduce")(reduce)
    numpy_function(f"{ufunc}.outer")(outer)


for _ufunc in ELEMENTWISE.keys() - UNARY:
    _register_ufunc_methods(_ufunc)


# --- differences --------------------------------------------------------------------------------------------------------


@numpy_function()
def diff(a: Array, n: int = 1, axis: int = -1, prepend: Any = None, append: Any = None) -> Any:
    (at,) = a.row_axes(axis)
    edge = (*a.row_shape[:at], 1, *a.row_shape[at + 1 :])
    ends = [
        x if x is a or x is None or as_array(x).ndim else broadcast(as_array(x), edge, a.batch_axis)
        for x in (prepend, a, append)
    ]
    a = (
        concatenate([as_array(x) for x in ends if x is not None], at)
        if prepend is not None or append is not None
        else a
    )
    op = "not_equal" if a.kind == "bool" else "subtract"
    for _ in range(n):
        a = elementwise(op, a[(*(ALL,) * at, slice(1, None))], a[(*(ALL,) * at, slice(None, -1))])
    return a


@numpy_function()
def ediff1d(ary: Array) -> Any:
    return diff(_flat(ary))


@numpy_function()
def gradient(f: Array, *varargs: Any, axis: Any = None, edge_order: int = 1) -> Any:
    """Central differences inside, and one-sided differences at the ends."""
    axes = f.row_axes(axis)
    spacings = [as_array(x) for x in (varargs if len(varargs) == len(axes) else (varargs or (1.0,)) * len(axes))]
    slopes = [
        _gradient_along(as_numbers(f), at, spacing, edge_order) for at, spacing in zip(axes, spacings, strict=True)
    ]
    return slopes[0] if isinstance(axis, int) or len(slopes) == 1 else slopes


def _gradient_along(f: Array, at: int, spacing: Array, edge_order: int) -> Any:
    size = f.row_shape[at]
    if size < edge_order + 1:
        raise ValueError(f"np.gradient needs at least {edge_order + 1} numbers along its axis")

    def entries(index: Any) -> Any:
        return f[(*(ALL,) * at, index)]

    x = [float(v) for v in constant_of(spacing, "the spacing of np.gradient").ravel()]
    x = [i * x[0] for i in range(size)] if len(x) == 1 else x
    shape = [-1 if i == at else 1 for i in range(f.ndim)]

    def column(values: list[float]) -> Array:
        return as_array(values).reshaped(shape, None)

    before, behind = [x[i] - x[i - 1] for i in range(1, size - 1)], [x[i + 1] - x[i] for i in range(1, size - 1)]
    pieces = [entries(slice(0, 1)), *([entries(slice(1, -1))] if size > 2 else []), entries(slice(-1, None))]
    pieces[0] = (entries(slice(1, 2)) - entries(slice(0, 1))) / (x[1] - x[0])
    pieces[-1] = (entries(slice(-1, None)) - entries(slice(-2, -1))) / (x[-1] - x[-2])
    if size > 2:
        inner = [
            (-d1 / (d0 * (d0 + d1)), (d1 - d0) / (d0 * d1), d0 / (d1 * (d0 + d1)))
            for d0, d1 in zip(before, behind, strict=True)
        ]
        left, middle, right = (column([weights[i] for weights in inner]) for i in range(3))
        pieces[1] = entries(slice(None, -2)) * left + entries(slice(1, -1)) * middle + entries(slice(2, None)) * right
    if edge_order == 2:
        h = x[1] - x[0]
        pieces[0] = (-1.5 * entries(slice(0, 1)) + 2.0 * entries(slice(1, 2)) - 0.5 * entries(slice(2, 3))) / h
        pieces[-1] = (0.5 * entries(slice(-3, -2)) - 2.0 * entries(slice(-2, -1)) + 1.5 * entries(slice(-1, None))) / h
    return concatenate(pieces, at)


@numpy_function("trapezoid", "trapz")
def trapezoid(y: Array, x: Any = None, dx: Any = 1.0, axis: int = -1) -> Any:
    (at,) = y.row_axes(axis)
    width = as_array(dx)
    if x is not None:
        x = as_array(x)
        width = diff(x, 1, 0 if x.ndim == 1 else at)
        width = width[(..., *(None,) * (y.ndim - 1 - at))] if x.ndim == 1 and y.ndim > 1 else width
    both = elementwise("add", y[(*(ALL,) * at, slice(1, None))], y[(*(ALL,) * at, slice(None, -1))])
    return along("sum", elementwise("multiply", width, elementwise("divide", both, 2.0)), at)


# --- order --------------------------------------------------------------------------------------------------------------


@numpy_function()
def sort(a: Array, axis: Any = -1, kind: Any = None, stable: Any = None) -> Array:
    return _scan("sort", a, axis)


@numpy_function()
def argsort(a: Array, axis: Any = -1, kind: Any = None, stable: Any = None) -> Array:
    return _scan("argsort", a, axis)


@numpy_function()
def partition(a: Array, kth: Any, axis: Any = -1, kind: Any = None) -> Array:
    """Sorted completely, which every partition allows."""
    return _scan("sort", a, axis)


@numpy_function()
def argpartition(a: Array, kth: Any, axis: Any = -1, kind: Any = None) -> Array:
    return _scan("argsort", a, axis)


@numpy_function()
def lexsort(keys: Any, axis: int = -1) -> Array:
    """Sort by the last key, then by the one before it, and so on: by the first, then stably by the others."""
    arrays = list(keys) if not isinstance(keys, Array) else [keys[i] for i in range(keys.row_shape[0])]
    order: Any = None
    for key in as_arrays(arrays):
        at = key.axis(axis)
        ordered = key if order is None else FUNCTIONS["take_along_axis"](key, order, at)
        sorted_ = _scan("argsort", ordered, at)
        order = sorted_ if order is None else FUNCTIONS["take_along_axis"](order, sorted_, at)
    return order


@numpy_function()
def median(a: Array, axis: Any = None, *, keepdims: Any = False, overwrite_input: Any = False) -> Any:
    return quantile(a, 0.5, axis, keepdims=keepdims)


@numpy_function()
def percentile(a: Array, q: Any, axis: Any = None, *, method: Any = "linear", keepdims: Any = False) -> Any:
    return quantile(a, elementwise("divide", as_array(q), 100.0), axis, method=method, keepdims=keepdims)


@numpy_function()
def quantile(a: Array, q: Any, axis: Any = None, *, method: Any = "linear", keepdims: Any = False) -> Any:
    """Between the two entries of the sorted numbers at (n - 1) q; NaN if one of the numbers is NaN."""
    fractions = constant_of(q, "q of np.quantile")
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
    ordered, is_nan = _scan("sort", x, at), along("any", elementwise("isnan", x), at)
    if ((fractions < 0) | (fractions > 1)).any():
        raise ValueError("quantiles are between 0 and 1, percentiles between 0 and 100")
    results = [
        elementwise("where", is_nan, math.nan, _at_fraction(ordered, at, float(fraction), str(method)))
        for fraction in fractions.ravel()
    ]
    if keepdims:
        kept = tuple(1 if i in axes else size for i, size in enumerate(a.row_shape))
        results = [result.reshaped(kept, a.batch_axis) for result in results]
    return results[0] if not fractions.ndim else stack(results, 0)


def _at_fraction(ordered: Array, at: int, fraction: float, method: str) -> Any:
    position = fraction * (ordered.row_shape[at] - 1)
    low, high = (ordered[(*(ALL,) * at, i)] for i in (math.floor(position), math.ceil(position)))
    weights = {
        "linear": position - math.floor(position), "lower": 0.0, "higher": 1.0, "midpoint": 0.5,
        "nearest": float(round(position) - math.floor(position)),
    }  # fmt: skip
    if method not in weights:
        raise Refused("E-NUMPY", f"method={method[:40]!r}: use one of {', '.join(weights)}")
    weight = weights[method]
    return {0.0: low, 1.0: high}.get(weight, elementwise("add", low, (high - low) * weight))


@numpy_function("linalg.norm")
def norm(x: Array, ord: Any = None, axis: Any = None, keepdims: Any = False) -> Any:  # noqa: A002
    x = as_numbers(x)
    axes = x.row_axes(axis)
    if len(axes) > 1 and ord is not None:
        return _matrix_norm(x, ord, axes, keepdims)
    magnitude = elementwise("abs", x)
    if ord in (None, 2):
        return elementwise("sqrt", along("sum", elementwise("multiply", x, x), axis, keepdims))
    if ord in (math.inf, -math.inf):
        return along("max" if ord > 0 else "min", magnitude, axis, keepdims)
    if ord == 0:
        return elementwise("multiply", count_nonzero(x, axis, keepdims=keepdims), 1.0)
    return power(along("sum", power(magnitude, ord), axis, keepdims), 1 / float(ord))


def _matrix_norm(x: Array, order: Any, axes: tuple[int, ...], keepdims: Any) -> Any:
    """Frobenius' norm, or the largest sum of magnitudes of a column or of a row."""
    if order == "fro":
        return elementwise("sqrt", along("sum", elementwise("multiply", x, x), axes, keepdims))
    if order in (1, -1, math.inf, -math.inf):
        summed, other = axes if abs(order) == 1 else axes[::-1]
        sums = along("sum", elementwise("abs", x), summed, True)
        result = along("max" if order > 0 else "min", sums, other, True)
        return result if keepdims else result[tuple(0 if i in axes else ALL for i in range(x.ndim))]
    raise Refused("E-NUMPY", f"np.linalg.norm of matrices with ord={order!r} is not available: use 'fro', 1 or np.inf")


@numpy_function("linalg.vector_norm")
def vector_norm(x: Array, *, axis: Any = None, keepdims: Any = False, ord: Any = 2) -> Any:  # noqa: A002
    return norm(x, ord, axis, keepdims)
