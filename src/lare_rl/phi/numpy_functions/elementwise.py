"""NumPy's functions on each number."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, concatenate, elementwise, invert, power
from lare_rl.phi.graph import ELEMENTWISE
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import UFUNCS, as_numbers, as_operand, astype, call_numpy, numpy_function
from lare_rl.phi.operand import Operand

ALIASES = {
    "abs": "absolute", "remainder": "mod", "divide": "true_divide", "trunc": "fix", "arccos": "acos", "arcsin": "asin",
    "arctan": "atan", "arctan2": "atan2", "arccosh": "acosh", "arcsinh": "asinh", "arctanh": "atanh",
    "left_shift": "bitwise_left_shift", "right_shift": "bitwise_right_shift",
}  # fmt: skip
MAX_FLOAT32 = float(np.finfo(np.float32).max)


def _register_ufunc(names: str, function: Callable[..., Any], n_inputs: int) -> None:
    """Register a function on each number under NumPy's names, separated by spaces. `call_numpy` handles its `where=`."""

    def unary(x: Operand, /, *, where: Any = True) -> Any:
        return function(x)

    def binary(x1: Operand, x2: Operand, /, *, where: Any = True) -> Any:
        return function(x1, x2)

    numpy_function(*names.split())(unary if n_inputs == 1 else binary)
    UFUNCS.update(names.split())


for _op in ELEMENTWISE:
    _register_ufunc(f"{_op} {ALIASES.get(_op, '')}", partial(elementwise, _op), getattr(np, _op).nin)


for _names, _function in {
    "power pow": power,
    "fabs": lambda x: abs(x * 1.0),
    "float_power": lambda x, y: power(x * 1.0, y),
    "square": lambda x: power(x, 2),
    # An integer, such as 1 / 3, is cut to 0.
    "reciprocal": lambda x: 1.0 / x if x.kind == "float" else elementwise("where", abs(x) == 1, x, 0),
    "positive conj conjugate": lambda x: +x,
    "real": lambda x: x,
    "degrees rad2deg": lambda x: x * (180 / math.pi),
    "radians deg2rad": lambda x: x * (math.pi / 180),
    "bitwise_not invert bitwise_invert": invert,
    "isposinf": lambda x: x == math.inf,
    "isneginf": lambda x: x == -math.inf,
    "ldexp": lambda x, n: x * elementwise("exp2", n),
    "divmod": lambda x, y: (x // y, x % y),
    "modf": lambda x: (
        elementwise("where", abs(x) == math.inf, 0.0, x - elementwise("trunc", x)),
        elementwise("trunc", x),
    ),
    # NaN stays NaN.
    "heaviside": lambda x, at_zero: elementwise(
        "where", x == 0, at_zero, elementwise("where", x != x, x, (x > 0) * 1.0)
    ),
    "sinc": lambda x: elementwise(
        "where", x == 0, 1.0, elementwise("sin", x * math.pi) / elementwise("where", x * math.pi == 0, 1.0, x * math.pi)
    ),
}.items():
    _register_ufunc(_names, _function, len(inspect.signature(_function).parameters))


# --- functions that are made of others ----------------------------------------------------------------------------------


@numpy_function()
def where(condition: Operand, x: Operand | None = None, y: Operand | None = None) -> Any:
    if x is None or y is None:
        raise RefusedError("E-NUMPY", "np.where needs three arguments: where a condition holds differs from row to row")
    return elementwise("where", condition, as_operand(x), as_operand(y))


@numpy_function()
def clip(a: Operand, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:  # noqa: A002
    for op, bound in (("maximum", min if a_min is None else a_min), ("minimum", max if a_max is None else a_max)):
        a = a if bound is None else elementwise(op, a, as_operand(bound))
    return +a


@numpy_function()
def nan_to_num(x: Operand, copy: Any = True, nan: Any = 0.0, posinf: Any = None, neginf: Any = None) -> Any:
    if getattr(x, "kind", "float") != "float":  # all numbers are finite
        return elementwise("where", True, x, x) if copy else x
    numbers = elementwise("where", x != x, nan, x)
    numbers = elementwise("where", numbers == math.inf, MAX_FLOAT32 if posinf is None else posinf, numbers)
    numbers = elementwise("where", numbers == -math.inf, -MAX_FLOAT32 if neginf is None else neginf, numbers)
    if copy or not isinstance(x, Array):
        return numbers
    x[...] = numbers
    return x


@numpy_function("round", "around", "round_")
def round_(a: Operand, decimals: int = 0) -> Any:
    if getattr(a, "kind", "float") == "int" and decimals >= 0:
        return +a
    if decimals == 0:
        return elementwise("rint", a)
    scale = 10.0 ** max(-30, min(decimals, 30))
    return elementwise("rint", a * scale) / scale


@numpy_function()
def isclose(a: Operand, b: Operand, rtol: Any = 1e-5, atol: Any = 1e-8, equal_nan: Any = False) -> Any:
    close = (abs(a - b) <= atol + rtol * abs(b)) & elementwise("isfinite", b) | (a == b)
    return close | ((a != a) & (b != b)) if equal_nan else close


@numpy_function()
def select(condlist: Sequence[Any], choicelist: Sequence[Any], default: Any = 0) -> Any:
    result = as_operand(default)
    for condition, choice in reversed(list(zip(condlist, choicelist, strict=True))):
        result = elementwise("where", condition, as_operand(choice), result)
    return result


@numpy_function()
def choose(a: Array, choices: Any) -> Any:
    choices = list(choices)
    return select([a == i for i in range(len(choices) - 1)], choices[:-1], choices[-1])


@numpy_function()
def unwrap(p: Array, discont: Any = None, axis: int = -1, *, period: Any = 2 * math.pi) -> Any:
    """Remove jumps of more than half a period: p_t + the sum over u <= t of the correction of p_u - p_(u-1)."""
    p = as_numbers(p)
    if p.row_shape[p.row_axes(axis)[0]] == 1:
        return p
    step = call_numpy("diff", [p], {"axis": axis})
    wrapped = (step + period / 2) % period - period / 2
    correction = elementwise("where", (wrapped == -period / 2) & (step > 0), period / 2, wrapped) - step
    correction = elementwise("where", abs(step) < (period / 2 if discont is None else discont), 0.0, correction)
    shift = call_numpy("cumsum", [correction], {"axis": axis})
    first = call_numpy("zeros_like", [p.select(p.axis(axis), slice(0, 1))], {})
    return p + concatenate([first, shift], axis)


@numpy_function()
def piecewise(x: Array, condlist: Any, funclist: Sequence[Any], *args: Any, **kw: Any) -> Any:
    """Choose by conditions; the last one that holds decides. `_convert_callables` has applied the functions to x."""
    conditions = list(condlist) if isinstance(condlist, (list, tuple)) else [condlist]
    result = as_operand(funclist[-1] if len(funclist) > len(conditions) else 0)
    for condition, choice in zip(conditions, funclist, strict=False):
        result = elementwise("where", condition, as_operand(choice), result)
    return astype(result, x.kind)
