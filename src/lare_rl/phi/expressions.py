"""Expressions of a program. Each kind of expression has one rule; all other kinds are refused."""

import ast
from collections.abc import Iterable, Sequence
from typing import Any

from lare_rl.phi.calls import evaluate_call
from lare_rl.phi.limits import MAX_INT_BITS, RefusedError
from lare_rl.phi.meter import check_key, check_text
from lare_rl.phi.operators import apply_unary, compare
from lare_rl.phi.runtime import Runtime
from lare_rl.phi.text import format_value
from lare_rl.phi.values import Iterator, Scope, Set, describe

__all__ = ["evaluate", "evaluate_entries"]


def evaluate(runtime: Runtime, node: ast.expr, scope: Scope) -> Any:
    """Return the value of an expression."""
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
            return evaluate_call(runtime, node, scope)
        case ast.BinOp(x, op, y):
            return runtime.binary(op, runtime.evaluate(x, scope), runtime.evaluate(y, scope))
        case ast.UnaryOp(op=op, operand=operand):
            return apply_unary(runtime, op, runtime.evaluate(operand, scope))
        case ast.Subscript(value=container, slice=index):
            return runtime.item(runtime.evaluate(container, scope), runtime.evaluate(index, scope))
        case ast.Slice(lower=lower, upper=upper, step=step):
            return slice(*(None if end is None else runtime.evaluate(end, scope) for end in (lower, upper, step)))
        case ast.Tuple(elts=items):
            return tuple(runtime.entries(items, scope))
        case ast.List(elts=items):
            return runtime.entries(items, scope)
        case ast.Set(elts=items):
            return Set(dict.fromkeys(map(check_key, runtime.entries(items, scope))))
        case ast.Dict(keys=keys, values=values):
            return _evaluate_dict(runtime, keys, values, scope)
        case ast.Compare():
            return _evaluate_comparison(runtime, node, scope)
        case ast.BoolOp():
            return _evaluate_and_or(runtime, node, scope)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            return runtime.evaluate(body if runtime.truth(runtime.evaluate(test, scope)) else orelse, scope)
        case ast.NamedExpr(target=ast.Name(id=name), value=value):
            result = runtime.evaluate(value, scope)
            scope.function.assign(name, result)
            return result
        case ast.Lambda():
            return runtime.define(node, scope)
        case ast.ListComp() | ast.GeneratorExp() | ast.SetComp() | ast.DictComp():
            return _evaluate_comprehension(runtime, node, scope)
        case ast.JoinedStr(values=values):
            text = ""
            for value in values:
                text = check_text(text + runtime.evaluate(value, scope))
            return text
        case ast.FormattedValue(value=value, format_spec=spec):
            format_spec = "" if spec is None else runtime.evaluate(spec, scope)
            return format_value(runtime.meter, runtime.evaluate(value, scope), format_spec)
        case ast.Yield() | ast.YieldFrom():
            return _evaluate_yield(runtime, node, scope)
    raise RefusedError("E-PYTHON", f"{type(node).__name__.lower()} is not available")


def evaluate_entries(runtime: Runtime, nodes: Sequence[ast.expr], scope: Scope) -> list[Any]:
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
    for key, node in zip(keys, values, strict=True):
        value = runtime.evaluate(node, scope)
        if key is not None:
            result[check_key(runtime.evaluate(key, scope))] = value
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


def _evaluate_comparison(runtime: Runtime, node: ast.Compare, scope: Scope) -> Any:
    """Compare each operand with the next one, until a comparison is false: a < b < c."""
    result: Any = True
    x = runtime.evaluate(node.left, scope)
    for i, (op, comparator) in enumerate(zip(node.ops, node.comparators, strict=True)):
        if i and not runtime.truth(result):
            break
        y = runtime.evaluate(comparator, scope)
        result, x = compare(runtime, op, x, y), y
    return result


def _evaluate_comprehension(
    runtime: Runtime, node: ast.ListComp | ast.GeneratorExp | ast.SetComp | ast.DictComp, scope: Scope
) -> Any:
    turns = _turns(runtime, node.generators, scope)
    if isinstance(node, ast.DictComp):
        return {check_key(runtime.evaluate(node.key, turn)): runtime.evaluate(node.value, turn) for turn in turns}
    items = [runtime.evaluate(node.elt, turn) for turn in turns]
    match node:
        case ast.SetComp():
            return Set(dict.fromkeys(map(check_key, items)))
        case ast.GeneratorExp():
            return Iterator(items)
    return items


def _turns(runtime: Runtime, generators: Sequence[ast.comprehension], scope: Scope) -> Iterable[Scope]:
    """Yield the scope of each turn of a comprehension."""
    first, *inner_generators = generators
    for item in runtime.items(runtime.evaluate(first.iter, scope)):
        runtime.meter.pay()
        inner = Scope(scope, "comprehension")
        runtime.assign(first.target, item, inner)
        if all(runtime.truth(runtime.evaluate(test, inner)) for test in first.ifs):
            yield from _turns(runtime, inner_generators, inner) if inner_generators else [inner]
