"""The functions of NumPy that a program can call, by name. Nothing else of NumPy can be reached.

A function is registered with NumPy's name and parameters. `_CONVERSIONS` converts its arguments by their annotations: to an
`Array`, an `Operand` (an array or x[mask]), a list, a number. `call_numpy` handles `out=` and `dtype=` for all functions.
"""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array, elementwise
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import NumberKind, widest
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.operand import Operand
from lare_rl.phi.values import Symbol, describe

Function = Callable[..., Any]

FUNCTIONS: dict[str, Function] = {}
"""Functions by their names behind `np.`: "sum", "linalg.norm", "add.reduce"."""

KIND_OF_DTYPE: dict[str, NumberKind] = {
    **dict.fromkeys("float float16 float32 float64 double single half longdouble f4 f8 f d floating".split(), "float"),
    **dict.fromkeys(
        "int int8 int16 int32 int64 intp int_ uint8 uint16 uint32 uint64 uint i4 i8 i integer byte ubyte short".split(),
        "int",
    ),
    **dict.fromkeys("bool bool_ ?".split(), "bool"),
}
"""The kinds of NumPy's types. Their precision is ignored: all numbers are float32, int32 or bool when a graph is computed."""

IGNORED = frozenset("order casting subok copy like device".split())
"""Arguments of NumPy that change no number."""

HINTS = {
    "np.random": "a factor must not depend on chance",
    "np.unique": "count with comparisons, such as (x[:, :, None] == values).any(1)",
    "np.nanmedian": "replace NaN first, then use np.median",
    "np.nanpercentile": "replace NaN first, then use np.percentile",
    "np.nanquantile": "replace NaN first, then use np.quantile",
    "np.histogram": "count with comparisons, such as ((x >= low) & (x < high)).sum(axis=1)",
    "np.linalg.svd": "for 2 x 2 matrices, use np.linalg.eigvalsh; else sums of squares, np.trace or np.linalg.det",
    **dict.fromkeys(
        ["np.linalg.eig", "np.linalg.eigh", "np.linalg.eigvals"],
        "for symmetric 2 x 2 matrices, use np.linalg.eigvalsh; else np.trace or np.linalg.det",
    ),
    "np.linalg.lstsq": "use np.linalg.solve for at most 4 x 4 numbers",
    **dict.fromkeys("np.load np.save np.memmap np.fromfile np.loadtxt np.savetxt".split(), "a program has no files"),
}
"""What to write instead of some names that are not available, or only for constants."""

UFUNCS: set[str] = set()
"""Functions on each number that take `where=` together with `out=`."""

_SIGNATURES: dict[str, inspect.Signature] = {}
_CONVERTERS: dict[str, dict[str, Callable[[Any], Any]]] = {}
"""For each function, what converts its arguments."""


def numpy_function(*names: str) -> Callable[[Function], Function]:
    """Register a function under NumPy's names for it, or else under its own without a last underscore."""

    def register(function: Function) -> Function:
        signature = inspect.signature(function)
        converters = {
            key: _CONVERSIONS[parameter.annotation]
            for key, parameter in signature.parameters.items()
            if parameter.annotation in _CONVERSIONS
        }
        for name in names or (function.__name__.rstrip("_"),):
            FUNCTIONS[name], _SIGNATURES[name], _CONVERTERS[name] = function, signature, converters
        return function

    return register


def numpy_variants(table: Mapping[str, Any]) -> Callable[[Function], Function]:
    """Register one function for each row of a table: NumPy's names, separated by spaces, and the value that it takes first."""

    def register(function: Function) -> Function:
        for names, variant in table.items():
            numpy_function(*names.split())(functools.partial(function, variant))
        return function

    return register


def numpy_functions(table: Mapping[str, Function]) -> None:
    """Register functions under NumPy's names, separated by spaces."""
    for names, function in table.items():
        numpy_function(*names.split())(function)


def array_functions(table: Mapping[str, Function]) -> None:
    """Register functions whose arguments without a default become arrays."""
    numpy_functions(table)
    for names, function in table.items():
        parameters = inspect.signature(function).parameters
        converters = {key: as_array for key, p in parameters.items() if p.default is p.empty}
        _CONVERTERS.update(dict.fromkeys(names.split(), converters))


def call_numpy(name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    """Call a registered function with the values of a program."""
    signature = _SIGNATURES[name]
    arguments = {
        key: value
        for key, value in kwargs.items()
        if key in signature.parameters or key not in ("out", "dtype", *IGNORED)
    }
    try:
        bound = signature.bind(*args, **arguments)
    except TypeError as error:
        raise RefusedError("E-NUMPY", f"np.{name}: {error}; it takes {_signature_text(name)}") from None
    out, dtype = kwargs.get("out"), None if "dtype" in signature.parameters else kwargs.get("dtype")
    kind = None if dtype is None else dtype_kind(dtype)
    for key, convert in _CONVERTERS[name].items():
        if key in bound.arguments:
            several = signature.parameters[key].kind is inspect.Parameter.VAR_POSITIONAL
            values = [_widen(convert(x), kind) for x in (bound.arguments[key] if several else [bound.arguments[key]])]
            bound.arguments[key] = tuple(values) if several else values[0]
    if out is None and arguments.get("where", True) is not True and name in UFUNCS:
        raise RefusedError("E-NUMPY", f"np.{name} with where= needs out=, or the other numbers are undefined")
    result = FUNCTIONS[name](*bound.args, **bound.kwargs)
    if kind is not None:
        if kind != "float" and as_array(result).kind == "float":
            raise RefusedError("E-NUMPY", f"np.{name} of fractional numbers as another type: use astype")
        result = astype(result, kind)
    if out is not None:
        out = out[0] if isinstance(out, tuple) else out
        if not isinstance(out, Array):
            raise TypeError("out= must be an array")
        where = arguments.get("where", True) if name in UFUNCS else True
        out[...] = result if where is True else elementwise("where", where, result, out)
        return out
    return result


def _widen(value: Any, kind: NumberKind | None) -> Any:
    """Convert an argument as `dtype=` does in NumPy: before the function, so that np.add(True, True, dtype=int) is 2."""
    return value if kind is None or not isinstance(value, Array) else astype(value, widest([value.kind, kind]))


def _signature_text(name: str) -> str:
    parameters = _SIGNATURES[name].parameters.values()
    return ", ".join("*" * (p.kind is p.VAR_POSITIONAL) + p.name for p in parameters) or "no arguments"


def as_operand(value: Any) -> Any:
    """Return an operand or a complex number as it is, and other values as an array. Raises `TypeError` like `as_array`."""
    return value if isinstance(value, (Operand, complex)) else as_array(value)


def as_arrays(values: Any) -> list[Array]:
    """Return the entries of a list, tuple or array as arrays. Raises `TypeError` for other values."""
    if not isinstance(values, (list, tuple, Array)):
        raise TypeError("a list or tuple of arrays is needed")
    return [as_array(value) for value in values]


def as_list(value: Any) -> list[Any]:
    """Return the entries of a list, tuple, range or array, or a single value as a list."""
    several = isinstance(value, (list, tuple, range)) or (isinstance(value, Array) and value.ndim)
    return list(value) if several else [value]


def as_sizes(value: Any) -> list[int]:
    """Return an integer, or several, as a list."""
    return list(map(operator.index, as_list(value)))


def as_float(value: Any) -> float:
    """Return a number, or an array with one number, as a float.

    Raises:
        TypeError: another value.
        ValueError: an array with several numbers.
        RefusedError: an array that differs from row to row.
    """
    if not isinstance(value, (bool, int, float, Array)):
        raise TypeError(f"a number is needed, not {describe(value)}")
    return float(value)


def astype(x: Any, dtype: Any) -> Array:
    """Convert an array to the kind of a type. Raises `RefusedError` for types that `dtype_kind` refuses."""
    array = as_array(x)
    return Array(current_builder().cast(array.node, dtype_kind(dtype)), array.batch_axis)


def as_numbers(x: Any) -> Array:
    return astype(x, "float")


def dtype_kind(dtype: Any) -> NumberKind:
    """Return the kind of a type: "float32", np.float32, float, x.dtype. Raises `RefusedError` for other types."""
    name = dtype_name(dtype)
    if name not in KIND_OF_DTYPE:
        text = repr(name[:40]) if name else describe(dtype)
        raise RefusedError("E-NUMPY", f"{text} is no available type: use float, np.float32, int or bool")
    return KIND_OF_DTYPE[name]


def dtype_name(dtype: Any) -> str:
    """Return the name of a type without np.: of a string, a dtype, or a symbol such as np.float32. Else an empty text."""
    return str(dtype).removeprefix("np.") if isinstance(dtype, (str, Symbol, np.dtype)) else ""


def find_hint(name: str) -> str:
    """Return what to write instead of a name, as the end of a message. Empty if nothing is known."""
    return f": {HINTS[name]}" if name in HINTS else ""


def require_constant(x: Any, what: str, hint: str = "") -> Any:
    """Return the numbers of a constant. Raises `RefusedError` if they differ from row to row."""
    values = as_array(x).constant
    if values is None:
        raise RefusedError("E-NUMPY", f"{what} must be the same for all rows{hint}")
    return values


def _optional(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else convert(value)


_CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    "Array": as_array,
    "Operand": as_operand,
    "list[Array]": as_arrays,
    "list[int]": as_sizes,
    "int": operator.index,
    "float": as_float,
    "Operand | None": _optional(as_operand),
    "int | None": _optional(operator.index),
    "float | None": _optional(as_float),
}
