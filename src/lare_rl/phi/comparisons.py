"""Python's comparisons of the values of a program: numbers and arrays, types, objects of the program's classes."""

import ast
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from lare_rl.phi.arrays import Array, as_array
from lare_rl.phi.numpy_functions import call_numpy
from lare_rl.phi.numpy_functions.registry import dtype_name
from lare_rl.phi.operand import Operand
from lare_rl.phi.runtime import Runtime, check_key
from lare_rl.phi.values import Instance, Iterator, Set, Symbol, describe

__all__ = ["compare"]

COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not, ast.In: lambda x, y: x in y,
    ast.NotIn: lambda x, y: x not in y,
}  # fmt: skip
_MIRRORED = {"lt": "gt", "le": "ge", "gt": "lt", "ge": "le", "eq": "eq", "ne": "ne"}


def compare(runtime: Runtime, op: ast.cmpop, x: Any, y: Any) -> Any:
    """Return `x op y`. Raises `TypeError` if the values have no order."""
    runtime.meter.pay_for_all_within([x, y])
    if isinstance(op, (ast.In, ast.NotIn)):
        if isinstance(y, Instance):
            return _contains(runtime, y, x) == isinstance(op, ast.In)
        if isinstance(y, Array):
            return runtime.truth(call_numpy("any", [y == x], {})) == isinstance(op, ast.In)
        if isinstance(y, Iterator):
            return any(runtime.truth(compare(runtime, ast.Eq(), x, item)) for item in y.read()) == isinstance(
                op, ast.In
            )
        if isinstance(y, dict):
            x = check_key(x)
        elif isinstance(x, Operand) and isinstance(y, (list, tuple)):
            return any(runtime.truth(x == item) for item in y) == isinstance(op, ast.In)
    elif isinstance(x, Symbol) and isinstance(y, (Symbol, str)):
        return _is_same_type(x, y, strict=isinstance(op, (ast.Is, ast.IsNot))) == isinstance(op, (ast.Is, ast.Eq))
    elif isinstance(op, (ast.Is, ast.IsNot)):
        pass
    elif isinstance(x, Set) and isinstance(y, Set):
        x, y = set(x), set(y)
    elif isinstance(x, Iterator) and isinstance(op, (ast.Eq, ast.NotEq)):
        return (x is y) == isinstance(op, ast.Eq)
    elif isinstance(x, Instance) or isinstance(y, Instance):
        return _compare_instances(runtime, op, x, y)
    elif isinstance(x, Operand) != isinstance(y, Operand):
        if x is None or y is None:
            return isinstance(op, ast.NotEq)
        x, y = (value if isinstance(value, Operand) else as_array(value) for value in (x, y))
    try:
        return COMPARISONS[type(op)](x, y)
    except TypeError:
        if isinstance(op, (ast.In, ast.NotIn)):
            raise
        raise TypeError(f"{describe(x)} and {describe(y)} have no order") from None


def _is_same_type(x: Symbol, y: Symbol | str, *, strict: bool) -> bool:
    """Compare functions, or types: of numbers by `np.dtype`, so that `x.dtype == float` is as in NumPy."""
    names = [dtype_name(value) if isinstance(value, Symbol) else value for value in (x, y)]
    try:
        return x == y if strict else np.dtype(names[0]) == np.dtype(names[1])
    except TypeError:  # no types of numbers
        return x == y


def _contains(runtime: Runtime, container: Instance, item: Any) -> bool:
    if container.cls.has("__contains__"):
        return runtime.truth(runtime.call(runtime.attribute(container, "__contains__"), [item], {}))
    return runtime.truth(compare(runtime, ast.In(), item, tuple(runtime.items(container))))


def _compare_instances(runtime: Runtime, op: ast.cmpop, x: Any, y: Any) -> Any:
    """Compare objects of the program's classes: by their methods, or by their fields."""
    name = COMPARISONS[type(op)].__name__
    for owner, method, other in ((x, name, y), (y, _MIRRORED[name], x)):
        if isinstance(owner, Instance) and owner.cls.has(f"__{method}__"):
            return runtime.call(runtime.attribute(owner, f"__{method}__"), [other], {})
    if name == "ne" and isinstance(x, Instance) and x.cls.has("__eq__"):
        return not runtime.truth(_compare_instances(runtime, ast.Eq(), x, y))
    values = [_field_values(value) for value in (x, y)]
    are_alike = all(isinstance(value, tuple) for value in values) and (
        (isinstance(x, Instance) and isinstance(y, Instance) and x.cls is y.cls)
        or all(isinstance(value, tuple) or value.cls.is_tuple for value in (x, y))
    )
    if are_alike:
        return _compare_fields(runtime, op, *values)
    if name not in ("eq", "ne"):
        raise TypeError(f"{describe(x)} and {describe(y)} have no order")
    return (x is y) == (name == "eq")


def _field_values(value: Any) -> Any:
    """Return the fields of an object of a dataclass or of a named tuple, as a tuple. Other values are unchanged."""
    if isinstance(value, Instance) and (value.cls.is_dataclass or value.cls.is_tuple):
        return tuple(value.attributes[name] for name in value.cls.fields or ())
    return value


def _compare_fields(runtime: Runtime, op: ast.cmpop, x: tuple[Any, ...], y: tuple[Any, ...]) -> bool:
    """Compare tuples as Python does: by their first entries that differ, or by their lengths."""
    for a, b in zip(x, y, strict=False):
        if not runtime.truth(compare(runtime, ast.Eq(), a, b)):
            return isinstance(op, ast.NotEq) or (
                not isinstance(op, ast.Eq) and runtime.truth(compare(runtime, op, a, b))
            )
    return COMPARISONS[type(op)](len(x), len(y))
