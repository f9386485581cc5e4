"""NumPy's functions on each number."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, concatenate, elementwise, invert, power
from lare_rl.phi.graph import ELEMENTWISE
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import UFUNCS, as_numbers, as_operand, call_numpy, numpy_function
from lare_rl.phi.operand import Operand

UNARY = frozenset(
    "sqrt exp log log1p expm1 exp2 log2 log10 cbrt sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arccosh arctanh abs "
    "negative sign floor ceil trunc rint isnan isinf isfinite signbit logical_not".split()
)
ALIASES = {
    "abs": "absolute fabs", "remainder": "mod", "divide": "true_divide", "trunc": "fix", "arccos": "acos", "arcsin": "asin",
    "arctan": "atan", "arctan2": "atan2", "arccosh": "acosh", "arcsinh": "asinh", "arctanh": "atanh",
    "left_shift": "bitwise_left_shift", "right_shift": "bitwise_right_shift",
}  # fmt: skip
MAX_FLOAT32 = float(np.finfo(np.float32).max)


def _register_ufunc(op: str, function: Callable[..., Any]) -> None:
    def unary(x: Operand, /, *, where: Any = True) -> Any:
        return function(x)

    def binary(x1: Operand, x2: Operand, /, *, where: Any = True) -> Any:
        return function(x1, x2)

    names = [op, *ALIASES.get(op, "").split()]
    numpy_function(*names)(unary if op in UNARY else binary)
    UFUNCS.update(names)


for _op in ELEMENTWISE:
    _register_ufunc(_op, lambda *x, op=_op: elementwise(op, *x))


def _nonzero(x: Operand) -> Any:
    """Replace 0 by 1."""
    return elementwise("where", x == 0, 1.0, x)


UNARY |= {"square", "reciprocal", "positive", "degrees", "radians", "rad2deg", "deg2rad", "bitwise_not", "invert", "isneginf",
          "isposinf", "conj", "conjugate", "real", "bitwise_invert", "modf", "sinc"}  # fmt: skip
for _names, _function in {
    "power pow": power,
    "float_power": lambda x, y: power(x * 1.0, y),
    "square": lambda x: x * x,
    "reciprocal": lambda x: 1.0 / x,
    "positive conj conjugate real": lambda x: x,
    "degrees rad2deg": lambda x: x * (180 / math.pi),
    "radians deg2rad": lambda x: x * (math.pi / 180),
    "bitwise_not invert bitwise_invert": invert,
    "isposinf": lambda x: x == math.inf,
    "isneginf": lambda x: x == -math.inf,
    "ldexp": lambda x, n: x * elementwise("exp2", n),
    "divmod": lambda x, y: (x // y, x % y),
    "modf": lambda x: (x - elementwise("trunc", x), elementwise("trunc", x)),
    # NaN stays NaN.
    "heaviside": lambda x, at_zero: elementwise(
        "where", x == 0, at_zero, elementwise("where", x != x, x, (x > 0) * 1.0)
    ),
    "sinc": lambda x: elementwise("where", x == 0, 1.0, elementwise("sin", x * math.pi) / _nonzero(x * math.pi)),
}.items():
    for _name in _names.split():
        _register_ufunc(_name, _function)


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
    return a


@numpy_function()
def nan_to_num(x: Operand, copy: Any = True, nan: Any = 0.0, posinf: Any = None, neginf: Any = None) -> Any:
    numbers = elementwise("where", x != x, nan, x)
    numbers = elementwise("where", numbers == math.inf, MAX_FLOAT32 if posinf is None else posinf, numbers)
    numbers = elementwise("where", numbers == -math.inf, -MAX_FLOAT32 if neginf is None else neginf, numbers)
    if copy or not isinstance(x, Array):
        return numbers
    x[...] = numbers
    return x


@numpy_function("round", "around", "round_")
def round_(a: Operand, decimals: int = 0) -> Any:
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
    """P with jumps of more than half a period removed: p_t + sum over u <= t of the correction of p_u - p_(u-1)."""
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
    """Values, or results of functions, where conditions hold. The interpreter has applied the functions to x."""
    conditions = list(condlist) if isinstance(condlist, (list, tuple)) else [condlist]
    choices = list(funclist)
    default = choices[-1] if len(choices) > len(conditions) else 0
    result = as_operand(default)
    for condition, choice in zip(conditions, choices, strict=False):  # the last condition that holds decides
        result = elementwise("where", condition, as_operand(choice), result)
    return as_array(result) * 1.0 if x.kind == "float" else result
