"""Functions of numbers: float, round, and those of `math`."""

import ast
import functools
import math
import operator
from collections.abc import Callable
from typing import Any

from lare_rl.errors import short_repr
from lare_rl.phi.arrays import Array
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions import call_numpy
from lare_rl.phi.operand import Operand
from lare_rl.phi.runtime import BINARY, BUILTINS, Runtime, builtin, builtin_variants, check_number, varies

SAME_IN_NUMPY = {
    "fabs": "abs", "pow": "power", "atan2": "arctan2", "asin": "arcsin", "acos": "arccos", "atan": "arctan",
}  # fmt: skip


MAX_DIGITS = 1000
"""Characters of a text that becomes a number."""


@builtin_variants({"float": float, "int": int})
def number(kind: type, _: Runtime, /, x: Any = 0) -> Any:
    name = kind.__name__
    if isinstance(x, BatchSize):
        x.refuse()
    if varies([x]):
        raise RefusedError("E-FLOW", f"{name}() of numbers that differ from row to row: use astype({name})")
    if isinstance(x, str) and len(x) > MAX_DIGITS:
        raise RefusedError("E-COST", f"{name}() of a text with more than {MAX_DIGITS} characters")
    if not isinstance(x, (bool, int, float, str, Array)):
        raise TypeError(f"{name}() of a value that is no number")
    try:
        return check_number(kind(x))
    except ValueError:
        raise ValueError(f"{name}() of {short_repr(x)}") from None


@builtin("round")
def round_(_: Runtime, x: Any, ndigits: Any = None) -> Any:
    if isinstance(x, Array) and x.is_number and ndigits is None:
        x = x.number()
    if isinstance(x, Operand):
        return call_numpy("round", [x, ndigits or 0], {})
    return round(x) if ndigits is None else round(x, max(-30, min(operator.index(ndigits), 30)))


@builtin("divmod")
def divmod_(_: Runtime, x: Any, y: Any) -> Any:
    return call_numpy("divmod", [x, y], {}) if isinstance(x, Operand) or isinstance(y, Operand) else divmod(x, y)


MATH = (
    "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh degrees erf erfc exp expm1 fabs floor fmod gamma hypot isfinite "
    "isinf isnan isclose lgamma log log10 log1p log2 modf pow radians sin sinh sqrt tan tanh trunc remainder dist gcd lcm"
).split()


@builtin_variants({f"math.{name}": name for name in MATH})
def compute(name: str, runtime: Runtime, /, *args: Any, **kwargs: Any) -> Any:
    if varies(args):
        numpy_name = SAME_IN_NUMPY.get(name, name)
        raise RefusedError("E-FLOW", f"math.{name} takes one number, not an array: use np.{numpy_name}")
    numbers = [
        [float(item) for item in runtime.items(x)]
        if isinstance(x, (list, tuple))
        else (x if isinstance(x, int) else float(x))
        for x in args
    ]
    return check_number(getattr(math, name)(*numbers, **{key: float(x) for key, x in kwargs.items()}))


@builtin("math.factorial")
def factorial(_: Runtime, n: Any) -> int:
    return check_number(math.factorial(min(operator.index(n), 21)))  # 21! is too large


@builtin("math.comb")
def comb(_: Runtime, n: Any, k: Any) -> int:
    n, k = operator.index(n), operator.index(k)
    # Of 2k or more things, k >= 34 can be chosen in more ways than an integer may count.
    return check_number(math.comb(n, min(k, n - k, 34) if 0 <= k <= n else k))


def _operator(op: type[ast.operator]) -> Callable[..., Any]:
    return lambda runtime, x, y: runtime.binary(op(), x, y)


BUILTINS |= {
    "abs": lambda _, x: abs(x),
    "pow": _operator(ast.Pow),
    "bool": lambda runtime, x=False: runtime.truth(x),
    "math.prod": lambda runtime, values, start=1: functools.reduce(
        lambda x, y: runtime.binary(ast.Mult(), x, y), runtime.items(values), start
    ),
    "operator.neg": lambda _, x: -x,
    **{f"operator.{function.__name__}": _operator(op) for op, function in BINARY.items()},
}
