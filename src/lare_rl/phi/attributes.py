"""The modules that a program can import, and the attributes of its values. This file names all of them."""

import ast
import difflib
import functools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, Complex, Masked
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.calls import class_attribute
from lare_rl.phi.complex_numbers import call_with_complex
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions import FUNCTIONS, INDEXED, KIND_OF_DTYPE, Polynomial, call_numpy, find_hint
from lare_rl.phi.python_functions import BUILTINS
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.text import METHODS, call_method
from lare_rl.phi.values import Bound, Class, Function, Instance, Symbol, value_type

__all__ = ["get_attribute", "module_attribute", "resolve_import"]

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
) | {name for name in MODULES.values() if name.startswith("np.")}
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
"""Methods of arrays that are functions of NumPy with the same name and arguments."""


def resolve_import(statement: ast.Import | ast.ImportFrom) -> Iterable[tuple[str, Any]]:
    """Return the names that an import defines, and their values."""
    if isinstance(statement, ast.Import):
        for alias in statement.names:
            _check_module(alias.name)
            package = alias.name.partition(".")[0]
            yield alias.asname or package, Symbol(MODULES[alias.name if alias.asname else package])
        return
    module = statement.module or ""
    if statement.level:
        raise RefusedError("E-IMPORT", "relative imports are not available; numpy and math are")
    _check_module(module)
    for alias in statement.names:
        if alias.name == "*":
            prefix = f"{MODULES[module]}."
            names = [*CONSTANTS, *NAMES, *BUILTINS, *(f"np.{name}" for name in FUNCTIONS)]
            members = [name for name in names if name.rpartition(".")[0] == MODULES[module]]
            yield from ((name.removeprefix(prefix), CONSTANTS.get(name, Symbol(name))) for name in members)
            continue
        full = f"{module}.{alias.name}"
        value = Symbol(MODULES[full]) if full in MODULES else module_attribute(MODULES[module], alias.name)
        yield alias.asname or alias.name, value


def _check_module(name: str) -> None:
    if name not in MODULES:
        raise RefusedError("E-IMPORT", f"import {name[:60]}: this module is not available; numpy and math are")


def get_attribute(runtime: Runtime, owner: Any, name: str) -> Any:
    """Return owner.name.

    Raises:
        AttributeError: a class or an object of the program has no attribute of this name.
        RefusedError: this attribute of another value is not available.
    """
    match owner:
        case Instance() | Class():
            return class_attribute(runtime, owner, name)
        case Symbol(module):
            return module_attribute(module, name)
        case Array():
            return _array_attribute(runtime, owner, name)
        case Complex() | complex() if name in ("real", "imag"):
            return getattr(owner, name)
        case Complex() if name in ("shape", "ndim", "size"):
            return _array_attribute(runtime, owner.real, name)
        case Complex() if name == "T":
            return call_with_complex("transpose", [owner], {})
        case Complex():
            return Bound(lambda *args, **kwargs: _call_array_method(owner, name, args, kwargs))
        case Polynomial() if name == "coef" or (name in ("coeffs", "c") and not owner.rising):
            return owner.falling[::-1] if owner.rising else owner.falling
        case Polynomial() if name == "deriv":
            return Bound(lambda m=1: Polynomial(call_numpy("polyder", [owner.falling, m], {}), owner.rising))
        case np.finfo() | np.iinfo() if name in ("eps", "tiny", "max", "min", "resolution", "smallest_normal"):
            return np.asarray(getattr(owner, name)).item()
        case str() | list() | dict() if name in METHODS.get(type(owner), METHODS[list]):
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
    raise RefusedError("E-ATTRIBUTE", f".{name[:60]} of a {value_type(owner)} is not available")


def module_attribute(module: str, name: str) -> Any:
    full = f"{module}.{name}"
    if full in CONSTANTS:
        return CONSTANTS[full]
    if name == "__name__":
        return module.rpartition(".")[2]
    if module in ("typing", "__future__") or full in NAMES or full in BUILTINS:
        return Symbol(full)
    if module.startswith("np"):
        short = full.removeprefix("np.")
        if short in FUNCTIONS or full in INDEXED or short in KIND_OF_DTYPE or f"{short}.outer" in FUNCTIONS:
            return Symbol(full)
        raise RefusedError("E-NUMPY", f"{full[:80]} is not available{_hint(full)}")
    raise RefusedError("E-ATTRIBUTE", f"{full[:80]} is not available{_hint(full)}")


@functools.lru_cache(maxsize=256)
def _hint(full: str) -> str:
    """Return what to write instead of a name that is not available."""
    full = full[:80]
    if hint := find_hint(full):
        return hint
    names = [f"np.{name}" for name in FUNCTIONS] + list(BUILTINS)
    near = difflib.get_close_matches(full, names, 1, 0.8)
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
            return tuple(runtime.items(call_numpy("ravel", [array], {})))  # so that nothing is written into a copy
        case "item":
            return Bound(lambda *index: (array[index] if index else array).number())
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
