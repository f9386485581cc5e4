"""Functions of constants alone, and lookup in tables: steps, ramps, polynomials, sets."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, concatenate, elementwise
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import MAX_CONSTANT_SIZE, MAX_SYSTEM_SIZE, RefusedError
from lare_rl.phi.numpy_functions.reductions import along
from lare_rl.phi.numpy_functions.registry import (
    FUNCTIONS,
    array_functions,
    as_float,
    as_numbers,
    find_hint,
    numpy_function,
    numpy_variants,
    require_constant,
)


def register_constant_function(
    name: str,
    options: str = "",
    largest: int = MAX_CONSTANT_SIZE,
    work: Callable[[Any], int] = lambda x: 20 * np.size(x),
) -> None:
    """Register a function of constants that NumPy itself computes.

    Args:
        name: its name behind `np.`.
        options: the keywords that it takes.
        largest: the most numbers of an argument, and the largest integer or single number.
        work: what it costs to compute, for each of its arguments.
    """
    function: Any = functools.reduce(getattr, name.split("."), np)

    def compute(*args: Any, **kwargs: Any) -> Any:
        unknown = set(kwargs) - set(options.split())
        if unknown or len(args) > 3:
            raise RefusedError("E-NUMPY", f"np.{name} takes constants, and {options or 'no keywords'}")
        values = [plain_constant(x, name, largest) for x in args]
        more = {key: plain_constant(x, name, largest) for key, x in kwargs.items()}
        current_builder().spend(sum(map(work, values)))
        result = function(*values, **more)
        return tuple(map(as_array, result)) if isinstance(result, (tuple, list)) else as_array(result)

    numpy_function(name)(compute)


def plain_constant(x: Any, name: str, largest: int) -> Any:
    """Return a small constant as NumPy takes it: a number, or an array of at most two axes."""
    if isinstance(x, bool) or x is None:
        return x
    values = require_constant(x, f"the arguments of np.{name}", find_hint(f"np.{name}"))
    may_be_size = values.dtype.kind == "i" or not values.ndim  # np.hanning(5.0) is an array of five numbers
    if values.ndim > 2 or values.size > largest or (may_be_size and np.abs(values.astype(float)).max() > largest):
        raise RefusedError("E-COST", f"np.{name} of more than {largest} numbers, or of larger integers")
    return values.item() if values.ndim == 0 else values


for _largest, _options_by_name in {
    MAX_CONSTANT_SIZE: {
        **dict.fromkeys(
            "nonzero flatnonzero argwhere union1d intersect1d setdiff1d setxor1d array_equal trim_zeros i0 hanning hamming blackman "
            "bartlett kaiser".split(), "",
        ),
        "unique": "return_index return_inverse return_counts", "histogram": "bins", "bincount": "minlength",
        "vander": "N increasing", "triu_indices_from": "k", "tril_indices_from": "k",
    },
    MAX_SYSTEM_SIZE: {
        **dict.fromkeys("roots poly diag_indices gcd lcm".split(), ""), "polyfit": "deg", "tril_indices": "k m",
        "triu_indices": "k m", "cov": "ddof rowvar", "corrcoef": "rowvar", "allclose": "rtol atol",
        **dict.fromkeys("polyadd polysub polymul polyder polyint polydiv".split(), "m"),
        **{f"polynomial.polynomial.{name}": "m" for name in "polyder polyint polymul polyadd".split()},
    },
}.items():  # fmt: skip
    for _name, _options in _options_by_name.items():
        register_constant_function(_name, _options, _largest)
for _name in "pinv cholesky matrix_rank cond eigh svd svdvals qr".split():
    register_constant_function(f"linalg.{_name}", work=lambda x: np.size(x) * max(np.shape(x), default=1))


def _insertion_index(x: Array, edges: Array, side: str) -> Array:
    """Return how many edges lie below each number (side "left"), or not above it ("right"). NaN lies above all."""
    column = x[..., None]
    return along("sum", ~(column <= edges if side == "left" else column < edges), -1)


@numpy_function()
def searchsorted(a: Array, v: Array, side: Any = "left", sorter: Any = None) -> Any:
    edges = a if sorter is None else a[as_array(sorter)]
    edges.row_axes(0)  # refuses the batch axis
    return _insertion_index(v, edges, str(side))


@numpy_function()
def digitize(x: Array, bins: Array, right: Any = False) -> Any:
    edges = require_constant(bins, "the bins of np.digitize")
    index = _insertion_index(x, as_array(edges), "left" if right else "right")
    is_falling = len(edges) > 1 and edges[0] > edges[-1]
    return len(edges) - index if is_falling else index


@numpy_function()
def interp(x: Array, xp: Array, fp: Array, left: Any = None, right: Any = None, period: Any = None) -> Any:
    """Return the value at x of straight lines between the points (xp, fp), constant before the first and behind the last."""
    knots = require_constant(xp, "xp of np.interp").astype(float)
    x = as_numbers(x)
    if period is not None:
        period = abs(as_float(period))
        x %= period
        order = np.argsort(knots % period, kind="stable")
        fp, knots = fp[as_array(order)], (knots % period)[order]
        knots = np.concatenate([[knots[-1] - period], knots, [knots[0] + period]])
        fp = fp[as_array([len(order) - 1, *range(len(order)), 0])]
    if len(knots) != fp.row_shape[0] or not (np.diff(knots) >= 0).all():
        raise ValueError("np.interp needs rising xp, and as many fp")
    first, last = float(knots[0]), float(knots[-1])
    if last in knots[:-1] or len(knots) == 1:  # a jump at the end, or a single point
        knots, fp = np.append(knots, last + 1), concatenate([fp, fp[-1:]], 0)
    current_builder().check_size((math.prod(x.row_shape), len(knots)))
    start = _insertion_index(x, as_array(knots[1:-1]), "right") if len(knots) > 2 else elementwise("isnan", x) * 0
    low, high = fp[start], fp[start + 1]
    left_edge, width = as_array(knots[:-1])[start], as_array(np.diff(knots))[start]
    share = (x - left_edge) / elementwise("where", width == 0, 1.0, width)
    result = low + (high - low) * FUNCTIONS["clip"](share, 0.0, 1.0)
    result = elementwise("where", elementwise("isnan", x), math.nan, result)
    result = result if left is None else elementwise("where", x < first, left, result)
    return result if right is None else elementwise("where", x > last, right, result)


@numpy_function()
def unravel_index(indices: Array, shape: list[int], order: Any = "C") -> tuple[Any, ...]:
    return tuple((indices // stride) % size for stride, size in zip(_strides(shape, order), shape, strict=True))


@numpy_function()
def ravel_multi_index(multi_index: Any, dims: list[int], *, order: Any = "C") -> Any:
    strides = _strides(dims, order)
    return sum(as_array(index) * stride for index, stride in zip(multi_index, strides, strict=True))


def _strides(sizes: Sequence[int], order: Any) -> list[int]:
    if order != "C":
        raise RefusedError("E-NUMPY", "numbers are counted in the order 'C' alone: use np.transpose")
    current_builder().check_size(sizes)
    return [math.prod(sizes[i + 1 :]) for i in range(len(sizes))]


# --- polynomials --------------------------------------------------------------------------------------------------------


class Polynomial:
    """np.poly1d and np.polynomial.Polynomial: a function, with the coefficients from the highest power to the lowest."""

    def __init__(self, falling: Array, rising: bool = False):
        self.falling = falling
        self.rising = rising
        """Whether `coef` begins with the lowest power, as that of np.polynomial.Polynomial."""

    def __call__(self, x: Any) -> Any:
        return polyval(self.falling, as_array(x))


@numpy_function()
def polyval(p: Any, x: Array) -> Any:
    """p_0 x^n + ... + p_n, by Horner's rule."""
    coefficients = p.falling if isinstance(p, Polynomial) else as_array(p)
    result: Any = as_array(0.0)
    for i in range(coefficients.row_shape[0]):
        result = result * x + coefficients[i]
    return result


@numpy_function("polynomial.polynomial.polyval")
def rising_polyval(x: Array, c: Array, tensor: Any = True) -> Any:
    """c_0 + c_1 x + ... + c_n x^n. With `tensor`, each column of coefficients is a polynomial of all numbers."""
    c = c[(..., *(None,) * x.ndim)] if c.ndim > 1 and tensor else c
    return polyval(c[::-1], x)


SERIES: dict[str, Callable[..., Any]] = {
    "chebyshev.chebval": np.polynomial.chebyshev.chebval,
    "legendre.legval": np.polynomial.legendre.legval,
    "hermite.hermval": np.polynomial.hermite.hermval,
    "hermite_e.hermeval": np.polynomial.hermite_e.hermeval,
    "laguerre.lagval": np.polynomial.laguerre.lagval,
}
"""Series of polynomials. NumPy's functions are recurrences of `+`, `-` and `*`, which our arrays have too."""


@numpy_variants({f"polynomial.{name}": name for name in SERIES})
def series_value(name: str, x: Array, c: Any, tensor: Any = True) -> Any:
    coefficients = plain_constant(c, name, MAX_SYSTEM_SIZE)
    if np.ndim(coefficients) != 1:
        raise RefusedError("E-NUMPY", f"np.polynomial.{name} of several series: call it for each")
    return SERIES[name](x, coefficients)


array_functions(
    {
        "polynomial.Polynomial polynomial.polynomial.Polynomial": lambda coef: Polynomial(coef[::-1], rising=True),
        "poly1d": lambda c_or_r: Polynomial(_without_leading_zeros(c_or_r)),
    }
)


def _without_leading_zeros(coefficients: Array) -> Array:
    values = coefficients.constant
    return coefficients if values is None else as_array(np.poly1d(values).coeffs)


# --- sets ---------------------------------------------------------------------------------------------------------------


@numpy_function("isin", "in1d")
def isin(element: Array, test_elements: Any, assume_unique: Any = False, invert: Any = False) -> Any:
    values = as_array(list(test_elements) if isinstance(test_elements, (dict, range)) else test_elements)
    values.row_axes(None)
    hit = along("any", element[..., None] == values.reshaped((-1,), None), -1)
    return ~hit if invert else hit
