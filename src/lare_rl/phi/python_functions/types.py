"""Functions of types and attributes: isinstance, getattr, namedtuple, types of numbers, errors."""

import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions import FUNCTIONS
from lare_rl.phi.numpy_functions.registry import KIND_OF_DTYPE, astype, dtype_kind, dtype_name
from lare_rl.phi.runtime import BUILTINS, Runtime, builtin, check_text
from lare_rl.phi.text import format_value
from lare_rl.phi.values import (
    Bound,
    Class,
    Decorated,
    FrozenSet,
    Function,
    Instance,
    Iterator,
    Keys,
    Set,
    Symbol,
    value_type,
)

_EXCEPTIONS: list[type[Exception]] = [
    Exception, ValueError, TypeError, IndexError, KeyError, LookupError, ZeroDivisionError, ArithmeticError, AttributeError,
    AssertionError, RuntimeError, NotImplementedError, OverflowError, FloatingPointError, NameError,
]  # fmt: skip
ERRORS = {cls.__name__: [base.__name__ for base in cls.__mro__] for cls in _EXCEPTIONS}
"""The errors that a program can raise and catch, and the classes above them."""

_ITERABLE = ["collections.abc.Iterable", "typing.Iterable"]
_SEQUENCE = ["collections.abc.Sequence", "typing.Sequence", *_ITERABLE]
_MAPPING = ["collections.abc.Mapping", "typing.Mapping", *_ITERABLE]
_CALLABLE = ["collections.abc.Callable", "typing.Callable"]
_REAL = ["numbers.Number", "numbers.Real"]
_PARENTS = {
    "bool": ["int", *_REAL, "numbers.Integral"], "int": [*_REAL, "numbers.Integral"], "float": _REAL, "list": _SEQUENCE,
    "tuple": _SEQUENCE, "str": _SEQUENCE, "range": _SEQUENCE, "set": _ITERABLE, "frozenset": _ITERABLE, "iterator": _ITERABLE,
    "dict_keys": _ITERABLE,
    "dict": _MAPPING, "function": _CALLABLE, "np.ndarray": _ITERABLE, "type": _CALLABLE,
}  # fmt: skip
"""The types above a type."""
_NUMPY_SCALARS = {
    "float": ["float", "np.float64", "np.floating", "np.number", *_REAL],
    "int": ["np.int64", "np.integer", "np.number", *_PARENTS["int"]], "bool": ["np.bool_", "np.bool"],
}  # fmt: skip
"""The types of NumPy's numbers: float64 is a float of Python, too."""


_ITERATORS = frozenset("map filter zip enumerate reversed".split())
"""Types whose values a program has as an `Iterator`."""
_PYTHON_TYPES: dict[type, type] = {
    Set: set, FrozenSet: frozenset, Keys: type({}.keys()), Iterator: type(iter([])),
    **dict.fromkeys((Function, Bound), types.FunctionType),
    **{cls: cls for cls in (str, list, tuple, dict, range, bool, int, float, complex, slice, type(None))},
}  # fmt: skip
"""The types of Python that the types of values stand for."""
_NUMPY_TYPES = {"float": np.float64, "int": np.int64, "bool": np.bool_}
"""The types of NumPy's numbers, by their kinds."""
_MODULES = {"np": np, "math": math}


@builtin("isinstance")
def isinstance_(_: Runtime, value: Any, classes: Any) -> bool:
    classes = classes if isinstance(classes, tuple) else (classes,)
    if isinstance(value, Instance):
        instance_types = [
            value.cls,
            *value.cls.bases,
            Symbol("object"),
            *([Symbol("tuple")] if value.cls.is_tuple else []),
        ]
        for method, names in (("__call__", _CALLABLE), ("__iter__", _ITERABLE)):
            instance_types += map(Symbol, names) if value.cls.has(method) else []
        return any(cls in classes for cls in instance_types)
    name = value_type(value).name
    names = [name, "object", *_PARENTS.get(name, ())]
    if isinstance(value, Array) and value.is_number:
        names = [*_NUMPY_SCALARS[value.kind], "np.generic", "object"]
    if any(isinstance(cls, Symbol) and cls.name in names for cls in classes):
        return True
    if isinstance(value, Iterator) and any(isinstance(cls, Symbol) and cls.name in _ITERATORS for cls in classes):
        raise RefusedError("E-PYTHON", "isinstance() cannot tell kinds of iterators apart")
    return False


@builtin("hasattr")
def hasattr_(runtime: Runtime, value: Any, name: str) -> bool:
    """Return whether a value has an attribute. No code of the program is carried out to find out."""
    runtime.meter.pay(len(name) + 100)
    if isinstance(value, Instance):
        is_own = name in value.attributes or value.cls.has(name) or value.cls.has("__getattr__")
        return is_own or name in dir(object)
    if isinstance(value, Class):
        return value.has(name) or name in dir(type)
    try:
        runtime.attribute(value, name)
    except (RefusedError, AttributeError):  # it may be one that Python or NumPy has
        return name in dir(_python_counterpart(value))
    return True


def _python_counterpart(value: Any) -> Any:
    """Return the module or the type of Python or NumPy that a value stands for."""
    if isinstance(value, Symbol):
        return _MODULES.get(value.name, types.FunctionType)
    if isinstance(value, Array):
        return _NUMPY_TYPES[value.kind] if value.is_number else np.ndarray
    return _PYTHON_TYPES.get(type(value), object)


@builtin("getattr")
def getattr_(runtime: Runtime, value: Any, name: str, *default: Any) -> Any:
    if default and not hasattr_(runtime, value, name):
        return default[0]
    return runtime.attribute(value, check_text(name))


@builtin("collections.namedtuple")
def namedtuple(runtime: Runtime, name: str, names: Any, defaults: Any = ()) -> Class:
    fields = names.replace(",", " ").split() if isinstance(names, str) else list(runtime.items(names))
    values = list(runtime.items(defaults))
    attributes = dict(zip(fields[len(fields) - len(values) :], values, strict=True))
    return Class(name, attributes, fields=fields, is_tuple=True)


@builtin("np.finfo", "np.iinfo")
def finfo(_: Runtime, dtype: Any) -> Any:
    name = dtype_name(dtype)
    if dtype_kind(dtype) == "int":
        return np.iinfo(np.int32 if "32" in name else np.int64)
    return np.finfo(np.float64 if name in ("float", "float64", "double", "f8") else np.float32)


@builtin("np.issubdtype")
def issubdtype(_: Runtime, dtype: Any, kind: Any) -> bool:
    names = [dtype_name(dtype), dtype_name(kind)]
    return names[1] in ("number", "generic") or KIND_OF_DTYPE.get(names[0]) == KIND_OF_DTYPE.get(names[1], "")


@builtin("np.frompyfunc")
def frompyfunc(runtime: Runtime, function: Any, nin: int, nout: int) -> Bound:
    return vectorize(runtime, function)


@builtin("np.vectorize")
def vectorize(runtime: Runtime, pyfunc: Any, otypes: Any = None, doc: Any = None, **_: Any) -> Bound:
    """Return a function of arrays. What it computes is computed with whole arrays, and so for each number."""

    def call(*args: Any, **kwargs: Any) -> Any:
        result = runtime.call(pyfunc, [as_array(x) for x in args], kwargs)
        if not otypes:
            return result
        if isinstance(result, (tuple, list)):
            return tuple(astype(x, dtype) for x, dtype in zip(result, otypes, strict=True))
        return astype(as_array(result), otypes[0])

    return Bound(call)


def _is_callable(value: Any) -> bool:
    if isinstance(value, Instance):
        return value.cls.has("__call__")
    if isinstance(value, Symbol):
        short = value.name.removeprefix("np.")
        return value.name in BUILTINS or short in FUNCTIONS or short in KIND_OF_DTYPE or short == "ndarray"
    return isinstance(value, (Function, Bound, Class))


def _conversion(dtype: str) -> Callable[..., Any]:
    return lambda _, x=0: astype(x, dtype)


BUILTINS |= {
    "type": lambda _, value: value.cls if isinstance(value, Instance) else value_type(value),
    "object": lambda _: Instance(Class("object", {})),
    "callable": lambda _, value: _is_callable(value),
    "types.SimpleNamespace": lambda _, **attributes: Instance(Class("SimpleNamespace", {}), attributes),
    "dataclasses.field": lambda _, *, default=None, default_factory=None, **more: (
        default if default_factory is None else Decorated("default_factory", default_factory)
    ),
    "np.dtype": lambda _, dtype: Symbol(f"np.{dtype_name(dtype)}") if dtype_kind(dtype) else None,
    "np.isscalar": lambda _, value: isinstance(value, (bool, int, float, str)) or getattr(value, "is_number", False),
    **{f"np.{name}": _conversion(name) for name in KIND_OF_DTYPE if name.isidentifier() and len(name) > 2},
    **{
        name: lambda runtime, *message: " ".join(format_value(runtime.meter, x, "") for x in message)[:200]
        for name in ERRORS
    },
}
