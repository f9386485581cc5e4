"""`phi` as part of a graph: its source is read, not run.

A walk over the syntax tree of a function that has passed the gate. Operations on arrays are added to the graph (`rows.py`).
Constants are computed, loops over them are unrolled, and calls of helper functions are inlined. Code that cannot be translated
raises `Untranslatable`.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lare.deploy.graph import Graph
from lare.deploy.rows import BATCH, FUNCTIONS, LARGEST, METHODS, Rows, Untranslatable, indexed, is_rows, joined
from lare.latent.language.allowed import NAME

MOST_STEPS = 20_000
"""Expressions that a walk evaluates at most, so that it ends."""
ARITHMETIC: dict[type, tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("add", operator.add),
    ast.Sub: ("subtract", operator.sub),
    ast.Mult: ("multiply", operator.mul),
    ast.Div: ("divide", operator.truediv),
    ast.Pow: ("power", operator.pow),
    ast.MatMult: ("matmul", operator.matmul),
    ast.Lt: ("less", operator.lt),
    ast.Gt: ("greater", operator.gt),
    ast.LtE: ("less_equal", operator.le),
    ast.GtE: ("greater_equal", operator.ge),
    ast.Eq: ("equal", operator.eq),
    ast.BitAnd: ("logical_and", operator.and_),
    ast.BitOr: ("logical_or", operator.or_),
}
WRITTEN = {ast.Mod: "%", ast.FloorDiv: "//", ast.NotEq: "!=", ast.BitXor: "^"}
"""Operators that are not translated, as they are written."""
CONSTANTS = {"np.pi": math.pi, "np.e": math.e, "np.newaxis": None, "np.inf": math.inf}
CASTS = frozenset({"float", "np.float32", "np.float64"})
OF_CONSTANTS = frozenset("sqrt exp log tanh cos sin abs square maximum minimum sum mean max min prod".split())
"""Functions of NumPy whose results for constants are no larger than these."""


class Returned(Exception):
    """A `return` statement was reached."""

    def __init__(self, value: Any):
        self.value = value


def factors(graph: Graph, source: str, observation: Rows, action: Rows) -> Rows:
    """The factors of steps, [batch *agents factors]: `phi` added to a graph.

    Raises:
        Untranslatable: the source has code that cannot be translated.
    """
    if not source:
        raise Untranslatable("a source that the gate has not passed")
    try:
        walk = Walk(source)
        found = walk.call(walk.names[NAME], [observation, action])
        if not isinstance(found, (list, tuple)) or not all(is_rows(one) and one.shape == (1,) for one in found):
            raise Untranslatable("factors that are not (batch, 1)")
        return joined(found, axis=1)
    except (
        TypeError,
        ValueError,
        KeyError,
        IndexError,
        AttributeError,
        ZeroDivisionError,
        OverflowError,
        RecursionError,
    ) as error:
        raise Untranslatable(str(error)) from error


def missing_translation(source: str, observation_size: int, action_size: int) -> str | None:
    """The part of a function that cannot be translated; None if all of it can.

    `source` has passed the gate; the sizes are those of the rows that it judges.
    """
    graph = Graph()
    observation = Rows(graph, graph.input("observation", (observation_size,)), (observation_size,))
    action = Rows(graph, graph.input("action", (action_size,)), (action_size,))
    try:
        factors(graph, source, observation, action)
    except Untranslatable as error:
        return str(error)
    return None


class Walk:
    """Executes a program on the names of a graph. `names` holds the values of its variables and functions."""

    def __init__(self, source: str):
        self.names: dict[str, Any] = {}
        self.steps = 0
        for statement in ast.parse(source).body:
            self.do(statement, self.names)

    def call(self, function: ast.FunctionDef, values: list[Any], named: Mapping[str, Any] | None = None) -> Any:
        """Call a function of the program."""
        arguments, names = function.args, dict(self.names)
        defaults = [self.value(one, names) for one in arguments.defaults]
        taken = [one.arg for one in arguments.args]
        names |= dict(zip(taken[len(taken) - len(defaults) :], defaults, strict=True))
        names |= dict(zip(taken, values, strict=False)) | dict(named or {})
        try:
            for statement in function.body:
                self.do(statement, names)
        except Returned as returned:
            return returned.value
        raise Untranslatable("a function that returns nothing")

    def do(self, statement: ast.stmt, names: dict[str, Any]) -> None:
        """Execute a statement."""
        match statement:
            case ast.Import(names=[ast.alias(name="numpy", asname="np")]) | ast.Expr(value=ast.Constant()):
                pass
            case ast.FunctionDef():
                names[statement.name] = statement
            case ast.Assign(targets=[target]):
                self.assign(target, self.value(statement.value, names), names)
            case ast.AugAssign(target=ast.Name(id=name)):
                names[name] = self.operation(statement.op, names[name], self.value(statement.value, names))
            case ast.For(target=target, orelse=[]):
                for one in self.items(statement.iter, names):
                    self.assign(target, one, names)
                    for inner in statement.body:
                        self.do(inner, names)
            case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[item])):
                names[name].append(self.value(item, names))
            case ast.Return(value=ast.expr() as value):
                raise Returned(self.value(value, names))
            case _:
                raise Untranslatable(f"a statement: {type(statement).__name__}")

    def assign(self, target: ast.expr, value: Any, names: dict[str, Any]) -> None:
        match target:
            case ast.Name(id=name):
                names[name] = value
            case ast.Tuple(elts=targets) if isinstance(value, (tuple, list)):
                for one, part in zip(targets, value, strict=True):
                    self.assign(one, part, names)
            case _:
                raise Untranslatable("an assignment to a part of an array")

    def items(self, node: ast.expr, names: dict[str, Any]) -> list[Any] | tuple[Any, ...] | range:
        """The items that a loop iterates over."""
        found = self.value(node, names)
        if not isinstance(found, (list, tuple, range)):
            raise Untranslatable("a loop over an array")
        return found

    def value(self, node: ast.expr, names: dict[str, Any]) -> Any:
        """Evaluate an expression."""
        self.steps += 1
        if self.steps > MOST_STEPS:
            raise Untranslatable("too long a program")
        match node:
            case ast.Constant(value=value):
                return value
            case ast.Name(id=name):
                return names[name]
            case ast.Tuple(elts=parts):
                return tuple(self.value(one, names) for one in parts)
            case ast.List(elts=parts):
                return [self.value(one, names) for one in parts]
            case ast.BinOp(left=left, op=op, right=right):
                return self.operation(op, self.value(left, names), self.value(right, names))
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self.operation(op, self.value(left, names), self.value(right, names))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                found = self.value(operand, names)
                return FUNCTIONS["negative"](found) if is_rows(found) else -found
            case ast.UnaryOp(op=ast.Invert(), operand=operand):
                return FUNCTIONS["logical_not"](self.value(operand, names))
            case ast.ListComp(elt=item, generators=[ast.comprehension(target=target, iter=over, ifs=[])]):
                inner, found = dict(names), []
                for one in self.items(over, names):
                    self.assign(target, one, inner)
                    found.append(self.value(item, inner))
                return found
            case ast.Subscript(value=of, slice=index):
                found, place = self.value(of, names), self.index(index, names)
                if not is_rows(found):
                    return found[place]
                return indexed(found, place if isinstance(place, tuple) else (place,))
            case ast.Attribute():
                return self.attribute(node, names)
            case ast.Call():
                return self.called(node, names)
        raise Untranslatable(f"an expression: {type(node).__name__}")

    def index(self, node: ast.expr, names: dict[str, Any]) -> Any:
        match node:
            case ast.Tuple(elts=parts):
                return tuple(self.index(one, names) for one in parts)
            case ast.Slice(lower=lower, upper=upper, step=step):
                return slice(*(None if one is None else self.value(one, names) for one in (lower, upper, step)))
        return self.value(node, names)

    def operation(self, op: ast.AST, left: Any, right: Any) -> Any:
        if type(op) not in ARITHMETIC:
            raise Untranslatable(f"the operator {WRITTEN.get(type(op), type(op).__name__)}")
        name, of_constants = ARITHMETIC[type(op)]
        if not (is_rows(left) or is_rows(right)):
            check_size(name, left, right)
            return of_constants(left, right)
        if name == "power" and not is_rows(right) and right == 2:  # correct for a negative base, too
            return FUNCTIONS["square"](left)
        return FUNCTIONS[name](left, right)

    def attribute(self, node: ast.Attribute, names: dict[str, Any]) -> Any:
        written = ast.unparse(node)
        if written in CONSTANTS:
            return CONSTANTS[written]
        found = self.value(node.value, names)
        if is_rows(found) and node.attr == "shape":
            return (BATCH, *found.shape)
        raise Untranslatable(f"an attribute: {node.attr}")

    def called(self, node: ast.Call, names: dict[str, Any]) -> Any:
        named = {one.arg: self.value(one.value, names) for one in node.keywords if one.arg not in (None, "dtype")}
        match node.func:
            case ast.Name(id=name) if isinstance(names.get(name), ast.FunctionDef):
                return self.call(names[name], [self.value(one, names) for one in node.args], named)
            case ast.Name(id="range" | "len" as name):
                return {"range": range, "len": len}[name](*(self.value(one, names) for one in node.args))
            case ast.Name(id="float"):
                return float(self.value(node.args[0], names))
            case ast.Attribute(value=ast.Name(id="np"), attr="arange"):
                return counted(*(self.value(one, names) for one in node.args), **named)
            case ast.Attribute(attr="astype", value=of) if ast.unparse(node.args[0]) in CASTS:
                return self.value(of, names).as_numbers()
            case ast.Attribute(attr=name, value=of) if name in METHODS and ast.unparse(of) != "np":
                return applied(name, [self.value(of, names), *(self.value(one, names) for one in node.args)], named)
            case ast.Attribute() if ast.unparse(node.func).removeprefix("np.") in FUNCTIONS:
                values = [self.value(one, names) for one in node.args]
                return applied(ast.unparse(node.func).removeprefix("np."), values, named)
        raise Untranslatable(f"a call of {ast.unparse(node.func)}")


def check_size(name: str, left: Any, right: Any) -> None:
    """Raise `Untranslatable` if the result for two constants would be large."""
    sizes = [value.size if isinstance(value, np.ndarray) else 1 for value in (left, right)]
    lists = [len(value) for value in (left, right) if isinstance(value, (list, tuple, str))]
    whole = [abs(value) for value in (left, right) if isinstance(value, int)]
    if math.prod(sizes) > LARGEST or (lists and math.prod(lists + whole) > LARGEST):
        raise Untranslatable("a large constant")
    if any(value > 2**64 for value in whole) or (name == "power" and np.max(np.abs(right)) > 64):
        raise Untranslatable("a large number")


def counted(start: Any, stop: Any = None, step: Any = 1) -> np.ndarray:
    """`numpy.arange`, of constants."""
    low, high = (0, start) if stop is None else (start, stop)
    if not (high - low) / step <= LARGEST:
        raise Untranslatable("a large constant")
    return np.arange(low, high, step)


def applied(name: str, values: list[Any], named: Mapping[str, Any]) -> Any:
    """Apply a function of NumPy. On constants, only functions whose results cannot become large are applied."""
    if any(is_rows(one) for value in values for one in (value if isinstance(value, list) else [value])):
        return FUNCTIONS[name](*values, **named)
    if name in ("asarray", "array"):
        return np.asarray(*values)
    if name not in OF_CONSTANTS:
        raise Untranslatable(f"np.{name} of constants")
    return getattr(np, name)(*values, **named)
