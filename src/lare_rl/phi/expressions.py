"""Expressions of a program, and Python's operators on its values. Each kind of expression has one rule; others are refused."""

import ast
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from lare_rl.phi.arrays import Array, Complex, as_array
from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.calls import define_function, super_object
from lare_rl.phi.comparisons import compare
from lare_rl.phi.limits import MAX_INT_BITS, RefusedError
from lare_rl.phi.numpy_functions import INDEXED, call_numpy
from lare_rl.phi.operand import Operand
from lare_rl.phi.runtime import BINARY, Runtime, check_key, check_number, check_text, make_set
from lare_rl.phi.text import combine_values, convert_value, format_value
from lare_rl.phi.values import Class, Function, Instance, Iterator, Scope, Set, Symbol, describe

__all__ = ["apply_binary", "evaluate", "get_item", "list_items", "test_truth"]

NUMBERS = (bool, int, float, complex)
UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg, ast.UAdd: operator.pos, ast.Invert: operator.invert,
}  # fmt: skip
GENERIC_TYPES = ("list", "tuple", "dict", "set", "type")
"""Types that annotations index: list[float]."""


def _apply_unary(runtime: Runtime, op: ast.unaryop, value: Any) -> Any:
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
    function = BINARY[type(op)]
    name = function.__name__.rstrip("_")
    for owner, method, other in ((x, f"__{name}__", y), (y, f"__r{name}__", x)):
        if isinstance(owner, Instance) and owner.cls.has(method):
            return runtime.call(runtime.attribute(owner, method), [other], {})
    if isinstance(x, Operand) or isinstance(y, Operand):
        runtime.meter.pay_for_all_within([x, y])
        sequence, times = (x, y) if isinstance(y, Operand) else (y, x)
        if name == "mul" and isinstance(sequence, (list, tuple)) and isinstance(times, Array) and times.is_integer:
            return combine_values(runtime.meter, name, sequence, times.number())
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


def get_item(runtime: Runtime, container: Any, index: Any) -> Any:
    runtime.meter.pay_for_all_within([index])
    match container:
        case Array() | Complex():
            return container[index]
        case Set() | Iterator():
            raise TypeError(f"{describe(container)} cannot be indexed")
        case dict():
            return container[check_key(index)]
        case list() | tuple() | range() | str():
            result = container[index]
            return runtime.meter.pay_for_list(result) if isinstance(index, slice) else result
        case Instance() if container.cls.is_tuple:
            return runtime.items(container)[index]
        case Instance():
            return runtime.call(runtime.attribute(container, "__getitem__"), [index], {})
        case Symbol(name) if name in INDEXED:
            return INDEXED[name][index]
        case Symbol("np.s_" | "np.index_exp"):
            return index
        case Symbol(name) if name in GENERIC_TYPES or name.startswith(("typing.", "np.typing.")):
            return container
    raise TypeError(f"{describe(container)} cannot be indexed")


def test_truth(runtime: Runtime, value: Any) -> bool:
    runtime.meter.pay()
    if isinstance(value, Instance):
        for method in ("__bool__", "__len__"):
            if value.cls.has(method):
                return bool(runtime.call(runtime.attribute(value, method), [], {}))
        return not value.cls.is_tuple or bool(value.cls.fields)
    return isinstance(value, Iterator) or bool(value)


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
        case Set():
            items = value.entries
        case dict() | Array():
            items = list(value)
        case Instance() if value.cls.is_tuple:
            items = [value.attributes[name] for name in value.cls.fields or ()]
        case Instance() if value.cls.has("__iter__"):
            items = runtime.items(runtime.call(runtime.attribute(value, "__iter__"), [], {}))
        case Class():  # the members of an Enum
            members = value.attributes.items()
            items = [x for name, x in members if not name.startswith("_") and not isinstance(x, Function)]
        case _:
            raise TypeError(f"{describe(value)} cannot be gone through")
    runtime.meter.pay(len(items))
    return items


def evaluate(runtime: Runtime, node: ast.expr, scope: Scope) -> Any:
    runtime.meter.pay()
    match node:
        case ast.Constant(value=value):
            if isinstance(value, bytes) or (isinstance(value, int) and value.bit_length() > MAX_INT_BITS):
                raise RefusedError("E-PYTHON", "a constant that is no ordinary number or text")
            return value
        case ast.Name(id=name):
            return scope.find(name)
        case ast.Attribute(value=owner, attr=name):
            return runtime.attribute(runtime.evaluate(owner, scope), name)
        case ast.Call():
            return _evaluate_call(runtime, node, scope)
        case ast.BinOp(x, op, y):
            return runtime.binary(op, runtime.evaluate(x, scope), runtime.evaluate(y, scope))
        case ast.UnaryOp(op=op, operand=operand):
            return _apply_unary(runtime, op, runtime.evaluate(operand, scope))
        case ast.Subscript(value=container, slice=index):
            return runtime.item(runtime.evaluate(container, scope), runtime.evaluate(index, scope))
        case ast.Slice(lower=lower, upper=upper, step=step):
            return slice(*(None if end is None else runtime.evaluate(end, scope) for end in (lower, upper, step)))
        case ast.Tuple(elts=items):
            return tuple(_evaluate_entries(runtime, items, scope))
        case ast.List(elts=items):
            return _evaluate_entries(runtime, items, scope)
        case ast.Set(elts=items):
            return make_set(_evaluate_entries(runtime, items, scope))
        case ast.Dict(keys=keys, values=values):
            return _evaluate_dict(runtime, keys, values, scope)
        case ast.Compare(first, ops, comparators):
            return _evaluate_comparison(runtime, first, list(zip(ops, comparators, strict=True)), scope)
        case ast.BoolOp():
            return _evaluate_and_or(runtime, node, scope)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            return runtime.evaluate(body if runtime.truth(runtime.evaluate(test, scope)) else orelse, scope)
        case ast.NamedExpr(target=ast.Name(id=name), value=value):
            result = runtime.evaluate(value, scope)
            scope.function.assign(name, result)
            return result
        case ast.Lambda():
            return define_function(runtime, node, scope)
        case ast.ListComp() | ast.GeneratorExp() | ast.SetComp() | ast.DictComp():
            return _evaluate_comprehension(runtime, node, scope)
        case ast.JoinedStr(values=values):
            text = ""
            for value in values:
                text = check_text(text + runtime.evaluate(value, scope))
            return text
        case ast.FormattedValue(value=value, conversion=conversion, format_spec=spec):
            format_spec, value = "" if spec is None else runtime.evaluate(spec, scope), runtime.evaluate(value, scope)
            return format_value(
                runtime.meter,
                convert_value(runtime.meter, value, chr(conversion) if conversion >= 0 else None),
                format_spec,
            )
        case ast.Yield() | ast.YieldFrom():
            return _evaluate_yield(runtime, node, scope)
    raise RefusedError("E-PYTHON", f"{type(node).__name__.lower()} is not available")


def _evaluate_call(runtime: Runtime, node: ast.Call, scope: Scope) -> Any:
    if isinstance(node.func, ast.Name) and node.func.id == "super" and not node.args:
        return super_object(scope)
    function = runtime.evaluate(node.func, scope)
    args = _evaluate_entries(runtime, node.args, scope)
    kwargs: dict[str, Any] = {}
    for keyword in node.keywords:
        value = runtime.evaluate(keyword.value, scope)
        more = {keyword.arg: value} if keyword.arg is not None else value
        if not isinstance(more, dict) or not all(isinstance(key, str) for key in more):
            raise TypeError("** needs a dictionary whose keys are texts")
        kwargs |= more
        runtime.meter.pay(len(more))
    runtime.line = runtime.builder.line = node.lineno
    result = runtime.call(function, args, kwargs)
    runtime.line = runtime.builder.line = node.lineno  # a function of the program has lines of its own
    return result


def _evaluate_entries(runtime: Runtime, nodes: Sequence[ast.expr], scope: Scope) -> list[Any]:
    """Return the values of a list. Some of them may be unpacked: [a, *b]."""
    values: list[Any] = []
    for node in nodes:
        if isinstance(node, ast.Starred):
            values.extend(runtime.items(runtime.evaluate(node.value, scope)))
            runtime.meter.pay_for_list(len(values))
        else:
            values.append(runtime.evaluate(node, scope))
    return values


def _evaluate_dict(
    runtime: Runtime, keys: Sequence[ast.expr | None], values: Sequence[ast.expr], scope: Scope
) -> dict[Any, Any]:
    result: dict[Any, Any] = {}
    for key_node, node in zip(keys, values, strict=True):
        key = None if key_node is None else check_key(runtime.evaluate(key_node, scope))
        value = runtime.evaluate(node, scope)
        if key_node is not None:
            result[key] = value
        elif isinstance(value, dict):  # {**other}
            result |= value
            runtime.meter.pay_for_list(len(result))
        else:
            raise TypeError(f"** of {describe(value)}")
    return result


def _evaluate_and_or(runtime: Runtime, node: ast.BoolOp, scope: Scope) -> Any:
    for operand in node.values[:-1]:
        value = runtime.evaluate(operand, scope)
        if runtime.truth(value) == isinstance(node.op, ast.Or):
            return value
    return runtime.evaluate(node.values[-1], scope)


def _evaluate_yield(runtime: Runtime, node: ast.Yield | ast.YieldFrom, scope: Scope) -> None:
    yielded = scope.function.yielded
    if yielded is None:
        raise RefusedError("E-PYTHON", "yield outside a function")
    value = None if node.value is None else runtime.evaluate(node.value, scope)
    if isinstance(node, ast.YieldFrom):
        yielded.extend(runtime.items(value))
    else:
        yielded.append(value)


def _evaluate_comparison(
    runtime: Runtime, first: ast.expr, comparisons: Sequence[tuple[ast.cmpop, ast.expr]], scope: Scope
) -> Any:
    """Compare each operand with the next one, until a comparison is false: a < b < c."""
    result: Any = True
    x = runtime.evaluate(first, scope)
    for i, (op, comparator) in enumerate(comparisons):
        if i and not runtime.truth(result):
            break
        y = runtime.evaluate(comparator, scope)
        result, x = compare(runtime, op, x, y), y
    return result


def _evaluate_comprehension(
    runtime: Runtime, node: ast.ListComp | ast.GeneratorExp | ast.SetComp | ast.DictComp, scope: Scope
) -> Any:
    inner = Scope(scope, "comprehension")
    turns = _turns(runtime, node.generators, scope, inner)
    if isinstance(node, ast.DictComp):
        return {check_key(runtime.evaluate(node.key, inner)): runtime.evaluate(node.value, inner) for _ in turns}
    items = [runtime.evaluate(node.elt, inner) for _ in turns]
    match node:
        case ast.SetComp():
            return make_set(items)
        case ast.GeneratorExp():
            return Iterator(items)
    return items


def _turns(runtime: Runtime, generators: Sequence[ast.comprehension], outer: Scope, inner: Scope) -> Iterable[None]:
    """Assign the targets of a comprehension in its scope `inner`, turn by turn. The first iterable is evaluated in `outer`."""
    first, *remaining = generators
    for item in runtime.items(runtime.evaluate(first.iter, outer)):
        runtime.meter.pay()
        runtime.assign(first.target, item, inner)
        if all(runtime.truth(runtime.evaluate(test, inner)) for test in first.ifs):
            yield from _turns(runtime, remaining, inner, inner) if remaining else [None]
