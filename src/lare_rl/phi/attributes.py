"""The modules that a program can import, and the attributes of its values. This file names all of them."""

import ast
import difflib
import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, Complex, Masked, refuse_complex
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.calls import class_attribute
from lare_rl.phi.complex_numbers import call_with_complex
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions import FUNCTIONS, INDEXED, KIND_OF_DTYPE, Polynomial, call_numpy, find_hint
from lare_rl.phi.python_functions import BUILTINS
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.text import METHODS, call_method
from lare_rl.phi.values import Bound, Class, Function, Instance, Symbol, describe

__all__ = ["get_attribute", "resolve_import", "symbol_attribute"]

MODULES = {
    "numpy": "np", "numpy.linalg": "np.linalg", "numpy.polynomial": "np.polynomial", "numpy.typing": "np.typing",
    "numpy.polynomial.polynomial": "np.polynomial.polynomial", "numpy.lib.stride_tricks": "np.lib.stride_tricks",
    "numpy.polynomial.chebyshev": "np.polynomial.chebyshev", "numpy.fft": "np.fft",
    **{name: name for name in (
        "math typing __future__ functools itertools operator collections collections.abc dataclasses enum warnings abc numbers "
        "types"
    ).split()},
}  # fmt: skip
"""Modules that can be imported. They have only the names below and the functions of `python_functions` and `numpy_functions`."""

NAMES = frozenset(
    "dataclasses.dataclass enum.Enum enum.IntEnum enum.IntFlag enum.auto abc.ABC abc.abstractmethod collections.abc.Sequence "
    "collections.abc.Callable collections.abc.Iterable collections.abc.Mapping functools.lru_cache functools.cache functools.wraps "
    "warnings.catch_warnings warnings.filterwarnings warnings.simplefilter warnings.warn numbers.Number numbers.Real "
    "numbers.Integral np.errstate np.printoptions np.seterr np.set_printoptions np.ndarray np.number np.generic "
    "np.linalg.LinAlgError np.polynomial.legendre np.polynomial.hermite np.polynomial.hermite_e np.polynomial.laguerre np.lib "
    "np.typing.NDArray np.typing.ArrayLike np.s_ np.index_exp".split()
) | frozenset(MODULES.values())
"""Types, modules and decorators that a program may name."""

CONSTANTS: dict[str, Any] = {
    "np.pi": math.pi, "np.e": math.e, "np.inf": math.inf, "np.nan": math.nan, "np.newaxis": None, "np.euler_gamma": np.euler_gamma,
    "np.True_": True, "np.False_": False, "math.pi": math.pi, "math.e": math.e, "math.inf": math.inf, "math.nan": math.nan,
    "math.tau": math.tau, "np.PINF": math.inf, "np.NINF": -math.inf, "np.Inf": math.inf, "np.NaN": math.nan,
}  # fmt: skip

ARRAY_METHODS = frozenset(
    "sum prod mean max min any all std var ptp argmax argmin argsort cumsum cumprod astype clip round flatten ravel dot repeat "
    "reshape squeeze swapaxes take transpose copy diagonal trace searchsorted nonzero argpartition conj conjugate choose".split()
)
"""Methods of arrays. `_call_array_method` calls the function of NumPy that has the same name and does the same."""


def resolve_import(statement: ast.Import | ast.ImportFrom) -> Iterator[tuple[str, Any]]:
    """Yield the names that an import defines, and their values."""
    if isinstance(statement, ast.Import):
        for alias in statement.names:
            _check_module(alias.name)
            package = alias.name.partition(".")[0]
            yield alias.asname or package, Symbol(MODULES[alias.name if alias.asname else package])
        return
    module = "." * statement.level + (statement.module or "")
    _check_module(module)
    for alias in statement.names:
        names = [alias.name]
        if alias.name == "*":
            all_names = (*CONSTANTS, *NAMES, *INDEXED, *BUILTINS, *(f"np.{name}" for name in FUNCTIONS))
            names = [name.rpartition(".")[2] for name in all_names if name.rpartition(".")[0] == MODULES[module]]
        yield from ((alias.asname or name, symbol_attribute(MODULES[module], name)) for name in names)


def _check_module(name: str) -> None:
    if name not in MODULES:
        raise RefusedError("E-IMPORT", f"import {name[:60]}: this module is not available: use numpy and math")


def get_attribute(runtime: Runtime, owner: Any, name: str) -> Any:
    """Return owner.name.

    Raises:
        AttributeError: a class or an object of the program has no attribute of this name.
        RefusedError: this attribute of another value is not available.
    """
    match owner:
        case Instance() | Class():
            return class_attribute(runtime, owner, name)
        case Symbol(owner_name):
            return symbol_attribute(owner_name, name)
        case Array():
            return _array_attribute(runtime, owner, name)
        case Complex() | complex() if name in ("real", "imag"):
            return getattr(owner, name)
        case Complex() if name in ("shape", "ndim", "size"):
            return _array_attribute(runtime, owner.real, name)
        case Complex() if name == "T":
            return call_with_complex("transpose", [owner], {})
        case Complex() if name in ARRAY_METHODS:
            return Bound(lambda *args, **kwargs: _call_array_method(owner, name, args, kwargs))
        case Complex():
            refuse_complex(f".{name[:60]}")
        case Polynomial() if name == "coef" or (name in ("coeffs", "c") and not owner.rising):
            return owner.falling[::-1] if owner.rising else owner.falling
        case Polynomial() if name == "deriv":
            return Bound(lambda m=1: Polynomial(call_numpy("polyder", [owner.falling, m], {}), owner.rising))
        case np.finfo() | np.iinfo() if name in ("eps", "tiny", "max", "min", "resolution", "smallest_normal"):
            return np.asarray(getattr(owner, name)).item()
        case str() | list() | dict() if name in METHODS.get(type(owner), ()):
            return Bound(lambda *args, **kwargs: call_method(runtime, owner, name, args, kwargs))
        case tuple() if name in ("index", "count"):
            return Bound(lambda *args: call_method(runtime, list(owner), name, args, {}))
        case slice() if name in ("start", "stop", "step"):
            return getattr(owner, name)
        case bool() | int() | float() if name in ("value", "real"):  # `value` of an entry of an Enum
            return owner
        case bool() | int() | float() if name == "item":
            return Bound(lambda: owner)
        case bool() | int() | float() if name == "is_integer":
            return Bound(lambda: float(owner).is_integer())
        case Function() if name == "__name__":
            return owner.name
        case Masked() if name == "copy":
            return Bound(lambda: owner)
        case Masked() if name in ("clip", "round"):
            return Bound(lambda *args, **kwargs: call_numpy(name, [owner, *args], kwargs))
        case Masked():
            text = f"x[mask].{name[:60]}: rows differ in what a mask selects: use np.where(mask, x, 0)"
            raise RefusedError("E-ROWS", text)
    raise RefusedError("E-ATTRIBUTE", f".{name[:60]} of {describe(owner)} is not available")


def symbol_attribute(owner_name: str, name: str) -> Any:
    """Return the attribute of a module, a function or a type. Raises `RefusedError` if it is not available."""
    full = f"{owner_name}.{name}"[:80]
    if full in CONSTANTS:
        return CONSTANTS[full]
    if name == "__name__":
        return owner_name.rpartition(".")[2]
    if owner_name in ("typing", "__future__") or full in NAMES or full in INDEXED or full in BUILTINS:
        return Symbol(full)
    short, is_numpy = full.removeprefix("np."), full.startswith("np.")
    if is_numpy and (short in FUNCTIONS or short in KIND_OF_DTYPE):
        return Symbol(full)
    raise RefusedError("E-NUMPY" if is_numpy else "E-ATTRIBUTE", f"{full} is not available{_hint_or_near_name(full)}")


@functools.lru_cache(maxsize=256)
def _hint_or_near_name(full: str) -> str:
    """Return what to write instead of a name, as the end of a message. Empty if nothing is known."""
    if hint := find_hint(full):
        return hint
    near = difflib.get_close_matches(full, [*(f"np.{name}" for name in FUNCTIONS), *BUILTINS], 1, 0.8)
    return f": is {near[0]} meant?" if near else ""


def _array_attribute(runtime: Runtime, array: Array, name: str) -> Any:
    match name:
        case "shape" | "ndim":
            return getattr(array, name)
        case "size":
            return call_numpy("size", [array], {})
        case "T" | "mT":
            return call_numpy("transpose" if name == "T" else "matrix_transpose", [array], {})
        case "real":
            return array
        case "dtype":
            return Symbol({"float": "np.float32", "int": "np.int64", "bool": "np.bool_"}[array.kind])
        case "flat":
            return tuple(runtime.items(call_numpy("ravel", [array], {})))  # a tuple: writing into a copy must fail
        case "item":
            return Bound(lambda *i: (call_numpy("ravel", [array], {}) if len(i) == 1 else array)[i].number())
        case "tolist":
            return Bound(lambda: _to_list(runtime, array))
        case "fill":
            return Bound(lambda value: array.__setitem__(..., value))
        case "sort" | "partition":  # in place, unlike the functions of these names
            return Bound(lambda *args, **kwargs: array.__setitem__(..., call_numpy(name, [array, *args], kwargs)))
        case "view":
            return Bound(lambda *dtype: array if not dtype else _refuse_view())
        case _ if name in ARRAY_METHODS:
            return Bound(lambda *args, **kwargs: _call_array_method(array, name, args, kwargs))
    names = difflib.get_close_matches(name, ARRAY_METHODS, 1, 0.8)
    more = f": is .{names[0]} meant?" if names else ": call a function of NumPy"
    raise RefusedError("E-ATTRIBUTE", f".{name[:60]} of an array is not available{more}")


def _refuse_view() -> None:
    raise RefusedError("E-ATTRIBUTE", ".view of another type is not available: use astype")


def _to_list(runtime: Runtime, array: Array) -> Any:
    values = array.constant
    if values is None:
        raise RefusedError("E-FLOW", "numbers that differ from row to row cannot become a list: compute with the array")
    runtime.meter.pay_for_list(values.size)
    return values.tolist()


def _call_array_method(array: Array | Complex, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a method of an array: the function of NumPy of this name."""
    call = call_with_complex if isinstance(array, Complex) else call_numpy
    if name == "flatten":
        return call("copy", [call("ravel", [array, *args], kwargs)], {})
    if name in ("reshape", "transpose") and (len(args) > 1 or (args and isinstance(args[0], BatchSize))):
        args = (args,)
    return call(name, [array, *args], kwargs)
