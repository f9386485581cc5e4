"""Python's operators on the values of a program: x + y, x < y, x[i], and what a loop goes through."""

import ast
import operator
from collections.abc import Callable, Sequence
from typing import Any

from lare_rl.phi.arrays import Array, Complex, as_array
from lare_rl.phi.batch import BatchSize
from lare_rl.phi.limits import MAX_INT_BITS, RefusedError
from lare_rl.phi.meter import check_key, check_number
from lare_rl.phi.numpy_functions import INDEXED, call_numpy
from lare_rl.phi.operand import Operand
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.text import combine_values
from lare_rl.phi.values import Class, Function, Instance, Iterator, Set, Symbol, describe

__all__ = ["apply_binary", "apply_unary", "compare", "get_item", "list_items", "test_truth"]

NUMBERS = (bool, int, float, complex)
BINARY: dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("add", operator.add), ast.Sub: ("sub", operator.sub), ast.Mult: ("mul", operator.mul),
    ast.Div: ("truediv", operator.truediv), ast.FloorDiv: ("floordiv", operator.floordiv), ast.Mod: ("mod", operator.mod),
    ast.Pow: ("pow", operator.pow), ast.BitAnd: ("and", operator.and_), ast.BitOr: ("or", operator.or_),
    ast.BitXor: ("xor", operator.xor), ast.LShift: ("lshift", operator.lshift), ast.RShift: ("rshift", operator.rshift),
}  # fmt: skip
UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg, ast.UAdd: operator.pos, ast.Invert: operator.invert,
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not, ast.In: lambda x, y: x in y,
    ast.NotIn: lambda x, y: x not in y,
}  # fmt: skip
GENERIC_TYPES = ("list", "tuple", "dict", "set", "type")
"""Types that annotations index: list[float]."""


def apply_unary(runtime: Runtime, op: ast.unaryop, value: Any) -> Any:
    if isinstance(op, ast.Not):
        return not runtime.truth(value)
    function = UNARY[type(op)]
    if isinstance(value, Instance):
        return runtime.call(runtime.attribute(value, f"__{function.__name__}__"), [], {})
    if not isinstance(value, (*NUMBERS, Operand)):
        raise TypeError(f"bad operand type for {type(op).__name__}: {describe(value)}")
    return function(value)


def apply_binary(runtime: Runtime, op: ast.operator, x: Any, y: Any) -> Any:
    if isinstance(op, ast.MatMult):
        return call_numpy("matmul", [x, y], {})
    name, function = BINARY[type(op)]
    for owner, method, other in ((x, f"__{name}__", y), (y, f"__r{name}__", x)):
        if isinstance(owner, Instance) and owner.cls.has(method):
            return runtime.call(runtime.attribute(owner, method), [other], {})
    if isinstance(x, Operand) or isinstance(y, Operand):
        runtime.meter.pay_for_all_within([x, y])
        return function(*(value if isinstance(value, (Operand, int, complex)) else as_array(value) for value in (x, y)))
    if isinstance(x, BatchSize) or isinstance(y, BatchSize):
        if not isinstance(x, (int, float, BatchSize)) or not isinstance(y, (int, float, BatchSize)):
            raise TypeError(f"the number of rows and {describe(x if isinstance(y, BatchSize) else y)}")
        return function(x, y)
    if isinstance(x, NUMBERS) and isinstance(y, NUMBERS):
        if isinstance(x, int) and isinstance(y, int) and name in ("pow", "lshift"):
            bits = x.bit_length() * y if name == "pow" else x.bit_length() + y
            if bits > 4 * MAX_INT_BITS:
                raise RefusedError("E-COST", "an integer is too large")
        return check_number(function(x, y))
    return combine_values(runtime.meter, name, x, y)


def compare(runtime: Runtime, op: ast.cmpop, x: Any, y: Any) -> Any:
    runtime.meter.pay_for_all_within([x, y])
    if isinstance(op, (ast.In, ast.NotIn)):
        if isinstance(x, Operand) and isinstance(y, (list, tuple)):
            return any(runtime.truth(x == item) for item in y) == isinstance(op, ast.In)
    elif not isinstance(op, (ast.Is, ast.IsNot)) and isinstance(x, Operand) != isinstance(y, Operand):
        if x is None or y is None:
            return isinstance(op, ast.NotEq)
        x, y = (value if isinstance(value, Operand) else as_array(value) for value in (x, y))
    return COMPARISONS[type(op)](x, y)


def get_item(runtime: Runtime, container: Any, index: Any) -> Any:
    """Return container[index]."""
    runtime.meter.pay_for_all_within([index])
    match container:
        case Array() | Complex():
            return container[index]
        case Set():
            raise TypeError("a set has no order: it cannot be indexed")
        case dict():
            return container[check_key(index)]
        case list() | tuple() | range() | str():
            result = container[index]
            return runtime.meter.pay_for_list(result) if isinstance(index, slice) else result
        case Instance() if container.cls.is_tuple:
            return runtime.items(container)[index]
        case Instance():
            return runtime.call(runtime.attribute(container, "__getitem__"), [index], {})
        case Symbol(name) if name.removeprefix("np.") in INDEXED and name.startswith("np."):
            return INDEXED[name.removeprefix("np.")][index]
        case Symbol("np.s_" | "np.index_exp"):
            return index
        case Symbol(name) if name in GENERIC_TYPES or name.startswith(("typing.", "np.typing.")):
            return container
    raise TypeError(f"{describe(container)} cannot be indexed")


def test_truth(runtime: Runtime, value: Any) -> bool:
    runtime.meter.pay()
    return bool(value)


def list_items(runtime: Runtime, value: Any) -> Sequence[Any]:
    """Return the entries that a loop goes through."""
    match value:
        case BatchSize():
            value.refuse()
        case Iterator():
            items = list(value)
            value.clear()
        case list() | tuple() | range() | str():
            items = value
        case dict() | Array():
            items = list(value)
        case Instance() if value.cls.is_tuple:
            items = [value.attributes[name] for name in value.cls.fields or ()]
        case Instance() if value.cls.has("__iter__"):
            items = runtime.items(runtime.call(runtime.attribute(value, "__iter__"), [], {}))
        case Class():  # the members of an Enum
            members = value.attributes.items()
            items = [
                member for name, member in members if not name.startswith("_") and not isinstance(member, Function)
            ]
        case _:
            raise TypeError(f"{describe(value)} cannot be gone through")
    runtime.meter.pay(len(items))
    return items
