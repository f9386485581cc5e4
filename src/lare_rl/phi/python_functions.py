"""The functions of Python and of its modules that a program can call. Each takes the interpreter first."""

from __future__ import annotations

import ast
import functools
import itertools
import math
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lare_rl.phi.arrays import Array, BatchSize, Operand, as_array
from lare_rl.phi.graph import Refused
from lare_rl.phi.numpy_functions import call_numpy
from lare_rl.phi.numpy_functions.registry import KIND_OF_DTYPE, astype, dtype_name, kind_of
from lare_rl.phi.text import formatted
from lare_rl.phi.values import (
    Bound,
    Class,
    Function,
    Instance,
    Iterator,
    Named,
    Set,
    as_key,
    checked_number,
    checked_text,
    type_of,
)

if TYPE_CHECKING:
    from lare_rl.phi.interpreter import Interpreter

NUMBERS = (bool, int, float)
ADDITION = Named("operator.add")
BUILTINS: dict[str, Callable[..., Any]] = {}
"""All functions, by names such as "len", "math.sqrt", "itertools.product"."""

_EXCEPTIONS: list[type[Exception]] = [
    Exception, ValueError, TypeError, IndexError, KeyError, LookupError, ZeroDivisionError, ArithmeticError, AttributeError,
    AssertionError, RuntimeError, NotImplementedError, OverflowError, FloatingPointError, NameError,
]  # fmt: skip
ERRORS = {cls.__name__: [base.__name__ for base in cls.__mro__] for cls in _EXCEPTIONS}
"""The errors that a program can raise and catch, and the classes above them."""


def builtin(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function of Python under these names."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        BUILTINS.update(dict.fromkeys(names, function))
        return function

    return register


def _varies(values: Iterable[Any]) -> bool:
    """Whether one of the values is an array that differs from row to row."""
    return any(isinstance(value, Array) and value.constant is None for value in values)


# --- numbers ------------------------------------------------------------------------------------------------------------


def _number(name: str, text: str, convert: Callable[[Any], Any]) -> None:
    def number(_: Interpreter, x: Any = 0) -> Any:
        if isinstance(x, BatchSize):
            x.refuse()
        if _varies([x]):
            raise Refused("E-FLOW", f"{name}() of numbers that differ from row to row: use astype({name})")
        if not isinstance(x, (*NUMBERS, str, Array)) or (
            isinstance(x, str) and not re.fullmatch(text, x, re.IGNORECASE)
        ):
            raise TypeError(
                f"{name}() of {x[:40]!r}" if isinstance(x, str) else f"{name}() of a value that is no number"
            )
        return checked_number(convert(x))

    builtin(name)(number)


_number("float", r"\s*[-+]?(\d{1,30}\.?\d{0,30}([eE][-+]?\d{1,3})?|inf|infinity|nan)\s*", float)
_number("int", r"\s*[-+]?\d{1,18}\s*", int)


def _extreme(name: str, function: Callable[..., Any]) -> None:
    def extreme(interpreter: Interpreter, *values: Any, key: Any = None, **default: Any) -> Any:
        items = interpreter.items(values[0]) if len(values) == 1 else values
        if _varies(items):
            raise Refused(
                "E-FLOW",
                f"{name}() of numbers that differ from row to row: use np.{name}imum, or np.{name} along axis=1",
            )
        return function(items, key=_key_function(interpreter, key), **default)

    builtin(name)(extreme)


_extreme("max", max)
_extreme("min", min)


def _key_function(interpreter: Interpreter, key: Any) -> Callable[[Any], Any] | None:
    def sort_key(item: Any) -> Any:
        value = interpreter.call(key, [item], {})
        interpreter.meter.pay_for_all_within([value])
        return value

    return None if key is None else sort_key


@builtin("sorted")
def sorted_(interpreter: Interpreter, values: Any, *, key: Any = None, reverse: Any = False) -> list[Any]:
    items = list(interpreter.items(values))
    if _varies(items):
        raise Refused("E-FLOW", "sorted() of numbers that differ from row to row: use np.sort along axis=1")
    return sorted(items, key=_key_function(interpreter, key), reverse=bool(reverse))


@builtin("sum", "math.fsum")
def sum_(interpreter: Interpreter, values: Any, start: Any = 0) -> Any:
    return functools.reduce(lambda x, y: interpreter.binary(ast.Add(), x, y), interpreter.items(values), start)


@builtin("round")
def round_(_: Interpreter, x: Any, ndigits: Any = None) -> Any:
    if isinstance(x, Operand):
        return call_numpy("round", [x, ndigits or 0], {})
    return round(x) if ndigits is None else round(x, max(-30, min(operator.index(ndigits), 30)))


@builtin("divmod")
def divmod_(_: Interpreter, x: Any, y: Any) -> Any:
    return call_numpy("divmod", [x, y], {}) if isinstance(x, Operand) or isinstance(y, Operand) else divmod(x, y)


SAME_IN_NUMPY = {
    "fabs": "abs",
    "pow": "power",
    "atan2": "arctan2",
    "asin": "arcsin",
    "acos": "arccos",
    "atan": "arctan",
}


def _math(name: str) -> None:
    def of_numbers(interpreter: Interpreter, *args: Any, **kwargs: Any) -> Any:
        if _varies(args):
            raise Refused(
                "E-FLOW", f"math.{name} takes one number, not an array: use np.{SAME_IN_NUMPY.get(name, name)}"
            )
        plain = [
            [float(item) for item in interpreter.items(x)]
            if isinstance(x, (list, tuple))
            else x
            if isinstance(x, int)
            else float(x)
            for x in args
        ]
        return checked_number(getattr(math, name)(*plain, **{key: float(x) for key, x in kwargs.items()}))

    builtin(f"math.{name}")(of_numbers)


for _name in (
    "acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh degrees erf erfc exp expm1 fabs floor fmod gamma hypot isfinite "
    "isinf isnan isclose lgamma log log10 log1p log2 modf pow radians sin sinh sqrt tan tanh trunc remainder dist gcd lcm"
).split():
    _math(_name)


@builtin("math.factorial")
def factorial(_: Interpreter, n: Any) -> int:
    return checked_number(math.factorial(min(operator.index(n), 21)))


@builtin("math.comb")
def comb(_: Interpreter, n: Any, k: Any) -> int:
    n, k = operator.index(n), operator.index(k)
    # Of 2k or more things, 34 <= k can be chosen in more ways than an integer may count.
    return checked_number(math.comb(n, min(k, n - k, 34) if 0 <= k <= n else k))


# --- lists and their like -----------------------------------------------------------------------------------------------


@builtin("len")
def len_(_: Interpreter, x: Any) -> Any:
    if isinstance(x, Array) and x.ndim:
        return x.shape[0]
    if isinstance(x, Class):
        return len([name for name in x.attributes if not name.startswith("_")])
    if isinstance(x, (list, tuple, dict, range, str)):
        return len(x)
    raise TypeError("len() of a value without entries")


@builtin("range")
def range_(interpreter: Interpreter, *ends: Any) -> range:
    result = range(*(operator.index(end) for end in ends))
    interpreter.meter.pay_for_list(len(result))
    return result


def _of_items(make: Callable[[Sequence[Any]], Any]) -> Callable[..., Any]:
    return lambda interpreter, values=(): make(interpreter.meter.pay_for_list(interpreter.items(values)))


@builtin("dict", "collections.OrderedDict")
def dict_(interpreter: Interpreter, values: Any = (), **more: Any) -> dict[Any, Any]:
    if isinstance(values, dict):
        interpreter.meter.pay_for_list(len(values))
        return dict(values) | more
    return {as_key(key): value for key, value in map(interpreter.items, interpreter.items(values))} | more


def _map(interpreter: Interpreter, function: Any, argument_lists: Iterable[Sequence[Any]]) -> Iterator:
    return Iterator(interpreter.call(function, list(args), {}) for args in argument_lists)


@builtin("filter")
def filter_(interpreter: Interpreter, function: Any, values: Any) -> Iterator:
    def keeps(item: Any) -> bool:
        return interpreter.truth(item if function is None else interpreter.call(function, [item], {}))

    return Iterator(filter(keeps, interpreter.items(values)))


@builtin("next")
def next_(_: Interpreter, iterator: Any, *default: Any) -> Any:
    if not isinstance(iterator, Iterator) or not (iterator or default):
        raise TypeError("next() of a value that is no iterator, or has no further entries")
    return iterator.pop(0) if iterator else default[0]


def _operator(op: type[ast.operator]) -> Callable[..., Any]:
    return lambda interpreter, x, y: interpreter.binary(op(), x, y)


BUILTINS |= {
    "abs": lambda _, x: abs(x),
    "math.prod": lambda interpreter, values, start=1: functools.reduce(
        lambda x, y: interpreter.binary(ast.Mult(), x, y), interpreter.items(values), start
    ),
    "pow": lambda interpreter, x, y: interpreter.binary(ast.Pow(), x, y),
    "bool": lambda interpreter, x=False: interpreter.truth(x),
    "all": lambda interpreter, values: all(map(interpreter.truth, interpreter.items(values))),
    "any": lambda interpreter, values: any(map(interpreter.truth, interpreter.items(values))),
    "list": _of_items(list),
    "tuple": _of_items(tuple),
    "set": _of_items(lambda values: Set(dict.fromkeys(map(as_key, values)))),
    "frozenset": _of_items(lambda values: Set(dict.fromkeys(map(as_key, values)))),
    "iter": _of_items(Iterator),
    "reversed": _of_items(lambda values: Iterator(list(values)[::-1])),
    "enumerate": lambda interpreter, values, start=0: Iterator(enumerate(interpreter.items(values), operator.index(start))),
    "zip": lambda interpreter, *values, strict=False: Iterator(zip(*map(interpreter.items, values), strict=bool(strict))),
    "map": lambda interpreter, f, *values: _map(interpreter, f, zip(*map(interpreter.items, values), strict=False)),
    "itertools.starmap": lambda interpreter, f, values: _map(interpreter, f, map(interpreter.items, interpreter.items(values))),
    "slice": lambda _, *ends: slice(*ends),
    "print": lambda _, *values, **more: None,
    "str": lambda interpreter, value="": formatted(interpreter.meter, value, ""),
    "repr": lambda interpreter, value: formatted(interpreter.meter, value, ""),
    "format": lambda interpreter, value, spec="": formatted(interpreter.meter, value, spec),
    "functools.partial": lambda interpreter, function, *args, **kwargs: Bound(
        lambda *more, **named: interpreter.call(function, [*args, *more], kwargs | named)
    ),
    "functools.reduce": lambda interpreter, function, values, *initial: functools.reduce(
        lambda x, y: interpreter.call(function, [x, y], {}), interpreter.items(values), *initial
    ),
    "itertools.accumulate": lambda interpreter, values, function=ADDITION, **initial: Iterator(
        itertools.accumulate(interpreter.items(values), lambda x, y: interpreter.call(function, [x, y], {}), **initial)
    ),
    "operator.neg": lambda _, x: -x,
    "operator.itemgetter": lambda interpreter, *keys: Bound(
        lambda x: interpreter.item(x, keys[0]) if len(keys) == 1 else tuple(interpreter.item(x, key) for key in keys)
    ),
    "operator.attrgetter": lambda interpreter, name: Bound(lambda x: interpreter.attribute(x, name)),
    "types.SimpleNamespace": lambda _, **attributes: Instance(Class("SimpleNamespace", {}), attributes),
    "dataclasses.field": lambda interpreter, *, default=None, default_factory=None, **_: (
        default if default_factory is None else interpreter.call(default_factory, [], {})
    ),
    **{
        f"operator.{name}": _operator(op)
        for name, op in {
            "add": ast.Add, "sub": ast.Sub, "mul": ast.Mult, "truediv": ast.Div, "floordiv": ast.FloorDiv, "mod": ast.Mod,
            "pow": ast.Pow, "and_": ast.BitAnd, "or_": ast.BitOr, "xor": ast.BitXor, "matmul": ast.MatMult,
        }.items()
    },
    **{
        name: lambda interpreter, *message: " ".join(formatted(interpreter.meter, x, "") for x in message)[:200]
        for name in ERRORS
    },
}  # fmt: skip


def _itertool(name: str, count: Callable[..., int]) -> None:
    """A function of itertools, whose results are counted and paid for first."""

    def results(interpreter: Interpreter, *args: Any, **kwargs: Any) -> Iterator:
        many = len(args) > 20 or any(isinstance(x, int) and x > 20 for x in (*args, *kwargs.values()))
        if many and name not in ("chain", "islice", "repeat"):
            raise Refused("E-COST", f"itertools.{name} of more than 20 entries at a time")
        plain = [x if isinstance(x, int) or x is None else list(interpreter.items(x)) for x in args]
        interpreter.meter.pay_for_list(count(*plain, **kwargs))
        return Iterator(getattr(itertools, name)(*plain, **kwargs))

    builtin(f"itertools.{name}")(results)


_itertool("chain", lambda *x: sum(map(len, x)))
_itertool("pairwise", len)
_itertool("combinations", lambda x, r: math.comb(len(x), r) * max(r, 1))
_itertool("combinations_with_replacement", lambda x, r: math.comb(len(x) + r, r) * max(r, 1))
_itertool("permutations", lambda x, r=None: math.perm(min(len(x), 30), r) * 20)
_itertool("product", lambda *x, repeat=1: math.prod(map(len, x)) ** operator.index(repeat) * (len(x) * repeat or 1))
_itertool("islice", lambda x, *ends: len(x))
_itertool("repeat", lambda x, times: max(times, 0))
_itertool("zip_longest", lambda *x, fillvalue=None: len(x) * max(map(len, x)))


@builtin("np.ndindex")
def ndindex(interpreter: Interpreter, *shape: Any) -> Iterator:
    sizes = shape[0] if len(shape) == 1 and isinstance(shape[0], (tuple, list)) else shape
    return BUILTINS["itertools.product"](interpreter, *(range_(interpreter, size) for size in sizes))


@builtin("collections.namedtuple")
def namedtuple(interpreter: Interpreter, name: str, names: Any, defaults: Any = ()) -> Class:
    fields = names.replace(",", " ").split() if isinstance(names, str) else list(interpreter.items(names))
    values = list(interpreter.items(defaults))
    return Class(name, dict(zip(fields[len(fields) - len(values) :], values, strict=True)), (), fields, True)


# --- types --------------------------------------------------------------------------------------------------------------

_SEQUENCE = ["collections.abc.Sequence", "typing.Sequence", "collections.abc.Iterable", "typing.Iterable"]
_REAL = ["numbers.Number", "numbers.Real"]
_ABOVE = {
    "bool": ["int", *_REAL, "numbers.Integral"], "int": [*_REAL, "numbers.Integral"], "float": _REAL, "list": _SEQUENCE,
    "tuple": _SEQUENCE, "dict": ["collections.abc.Mapping", "typing.Mapping"], "function": ["collections.abc.Callable"],
}  # fmt: skip


@builtin("isinstance")
def isinstance_(_: Interpreter, value: Any, kinds: Any) -> bool:
    wanted = kinds if isinstance(kinds, tuple) else (kinds,)
    if isinstance(value, Instance):
        return any(cls in wanted for cls in (value.cls, *value.cls.bases)) or Named("object") in wanted
    own = type_of(value).name
    names = (own, "object", *_ABOVE.get(own, ()))
    return any(isinstance(kind, Named) and kind.name in names for kind in wanted)


@builtin("hasattr")
def hasattr_(interpreter: Interpreter, value: Any, name: str) -> bool:
    """Whether there is an attribute. No code of the program is carried out to find out."""
    interpreter.meter.pay(len(name) + 100)
    if isinstance(value, Instance):
        return name in value.attributes or value.cls.has(name) or value.cls.has("__getattr__")
    if isinstance(value, Class):
        return value.has(name)
    try:
        interpreter.attribute(value, name)
    except (Refused, AttributeError):
        return False
    return True


@builtin("getattr")
def getattr_(interpreter: Interpreter, value: Any, name: str, *default: Any) -> Any:
    if default and not hasattr_(interpreter, value, name):
        return default[0]
    return interpreter.attribute(value, checked_text(name))


@builtin("np.finfo", "np.iinfo")
def finfo(_: Interpreter, dtype: Any) -> Any:
    name = dtype_name(dtype)
    if kind_of(dtype) == "int":
        return np.iinfo(np.int32 if "32" in name else np.int64)
    return np.finfo(np.float64 if name in ("float", "float64", "double", "f8") else np.float32)


@builtin("np.issubdtype")
def issubdtype(_: Interpreter, dtype: Any, kind: Any) -> bool:
    names = [dtype_name(dtype), dtype_name(kind)]
    return names[1] in ("number", "generic") or KIND_OF_DTYPE.get(names[0]) == KIND_OF_DTYPE.get(names[1], "")


def _conversion(name: str) -> Callable[..., Any]:
    return lambda _, x=0: astype(x, name)


BUILTINS |= {
    "type": lambda _, value: value.cls if isinstance(value, Instance) else type_of(value),
    "object": lambda _: Instance(Class("object", {})),
    "callable": lambda _, value: isinstance(value, (Function, Bound, Class)) or getattr(value, "name", "") in BUILTINS,
    "np.dtype": lambda _, dtype: Named(f"np.{dtype_name(dtype)}") if kind_of(dtype) else None,
    "np.isscalar": lambda _, value: isinstance(value, (*NUMBERS, str)),
    "np.vectorize": lambda interpreter, function, *_, **__: Bound(
        lambda *args, **kwargs: interpreter.call(function, [as_array(x) for x in args], kwargs)
    ),
    **{f"np.{name}": _conversion(name) for name in KIND_OF_DTYPE if name.isidentifier() and len(name) > 2},
}
BUILTINS["np.frompyfunc"] = BUILTINS["np.vectorize"]
