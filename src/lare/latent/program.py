"""From a source that the gate has passed to a function: every name bound to what `language` lists, every loop counted.

The program becomes the body of one function, which is run anew at each call, so that nothing that a call leaves behind
reaches the next one. Dotted names become plain ones that no source can spell (`np.sum` in one piece), so that no module
is in sight; imports, annotations and docstrings go; generators become lists. Loops, comprehensions and calls consume
fuel, and what can grow without a loop (`*` and `**` on integers and sequences) is bounded.
"""

import ast
import builtins
import copy
import functools
import math
import operator
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lare.latent.language import BUILTINS, CONSTANTS, DOTTED, DTYPES, NAME
from lare.latent.syntax import dotted, is_docstring

FILE = "latent_function.py"
"""What tracebacks call the program."""

FUEL = 20_000
"""Turns of loops, and calls, of one call of the program."""

LONGEST_SEQUENCE = 10_000
LARGEST_BITS = 4096

CALLED_TYPES = frozenset(f"numpy.{name}" for name in DTYPES)
"""Types that are called as functions too: `np.float32(x)`."""


class OutOfFuel(Exception):
    """The program made more turns than it may."""


class TooLarge(Exception):
    """A number or a sequence would grow beyond all bounds."""


class Program:
    """A compiled program. `steps` is how much fuel the last call took."""

    def __init__(self, source: str, functions: Mapping[str, Any] | None = None):
        """`functions` replaces what dotted names mean, for a call that is to be watched.

        Raises:
            SyntaxError: what passed the gate does not compile (as `return` outside of a function).
        """
        tree = ast.fix_missing_locations(Rewrite().program(ast.parse(source)))
        names = {**namespace(), **(functions or {}), "$burn": self.burn, "$range": self.range}
        exec(compile(tree, FILE, "exec", dont_inherit=True), names)
        self.make: Callable[[], Callable[[np.ndarray, np.ndarray], Any]] = names["$program"]
        self.steps = 0

    def __call__(self, observation: np.ndarray, action: np.ndarray) -> Any:
        self.steps = 0
        return self.make()(observation, action)

    def burn(self) -> bool:
        self.steps += 1
        if self.steps > FUEL:
            raise OutOfFuel(f"more than {FUEL} turns of loops and calls")
        return True

    def range(self, *limits: int) -> range:
        return bounded(builtins.range(*limits))


def namespace() -> dict[str, Any]:
    """Everything that a program can name, and nothing that leads further."""
    return dict(everything())


@functools.cache
def everything() -> dict[str, Any]:
    names: dict[str, Any] = {name: resolve(name) for name in DOTTED.keys() | CONSTANTS | {"numpy.errstate"}}
    names |= {name: only_numbers(names[name]) for name in DOTTED if name.startswith("numpy.") and name not in CONSTANTS}
    names |= {f"{name}()": only_numbers(names[name]) for name in CALLED_TYPES}
    names |= {name: getattr(builtins, name) for name in BUILTINS if name != "range"}  # which counts its turns
    for name, (plain, in_place) in OPERATORS.items():
        names |= {f"${name}": guarded(name, plain), f"$i{name}": guarded(name, in_place)}
    names |= {
        "$list": list,
        "$slice": slice,
        "$array": array_only,
        "$dtype": dtype_of,
        "$extend": extend,
        "round": rounded,
        "sum": total,
    }
    names |= {name: at_once(getattr(builtins, name)) for name in ("enumerate", "reversed", "zip")}
    # NumPy imports parts of itself through its caller's __import__, which no program can name.
    return {**names, "__builtins__": {"__import__": already_loaded}}


def resolve(name: str) -> Any:
    """What a dotted name of the language means."""
    module, *parts = name.split(".")
    value: Any = {"numpy": np, "math": math}[module]
    for part in parts:
        value = getattr(value, part)
    return value


def already_loaded(name: str, *rest: Any) -> Any:
    if name.partition(".")[0] == "numpy" and name in sys.modules:
        return sys.modules[name]
    raise ImportError(name)


# --- what can grow, or become something else than numbers ------------------------------------------------------------


def numbers(value: Any) -> Any:
    """The value. Arrays of objects and strings would lead around every other guard."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "fiubc":
        raise TypeError(f"arrays hold numbers only, not {value.dtype}")
    return value


def only_numbers(function: Callable[..., Any]) -> Callable[..., Any]:
    """A NumPy function whose results are numbers."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        return numbers(function(*arguments, **keywords))

    return call


def array_only(value: Any) -> np.ndarray:
    """What `out=` may be: without an array there, `where=` leaves memory that nobody has written."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"out= must be an array, not a {type(value).__name__}")
    return value


def dtype_of(value: Any) -> Any:
    return numbers(value).dtype


def rounded(value: Any, digits: int = 0) -> Any:
    """Python's own round would compute 10 to the power of a million."""
    if not isinstance(digits, int) or abs(digits) > 300:
        raise TooLarge("round to so many digits")
    return builtins.round(value, digits) if digits else builtins.round(value)


def total(values: Any, start: Any = 0) -> Any:
    """Python's own sum joins lists, again and again."""
    if isinstance(start, list | tuple | str):
        raise TooLarge("a sum of sequences")
    return numbers(builtins.sum(values, start))


def extend(target: Any, values: Any) -> None:
    """A list feeds on itself if it is extended by its own iterator."""
    if not isinstance(target, list) or not isinstance(values, list | tuple):
        raise TypeError("extend takes a list")
    check_joined(target, values)
    target.extend(values)


def at_once(function: Callable[..., Any]) -> Callable[..., list[Any]]:
    """A function that gives an iterator, as a list: iterators of iterators go deep without a loop."""

    def call(*arguments: Any, **keywords: Any) -> list[Any]:
        for argument in arguments:
            if hasattr(argument, "__len__"):
                bounded(argument)
        return list(function(*arguments, **keywords))

    return call


def bounded(sequence: Any) -> Any:
    if len(sequence) > FUEL:
        raise TooLarge(f"a sequence of {len(sequence)} entries")
    return sequence


SEQUENCES = (list, tuple, str)
INTEGERS = (int, np.integer)


def check_joined(left: Any, right: Any) -> None:
    if isinstance(left, SEQUENCES):
        if not isinstance(right, SEQUENCES):
            if isinstance(right, np.ndarray | np.generic):
                return  # NumPy takes the list for an array
            raise TypeError(f"a {type(left).__name__} and a {type(right).__name__} cannot be joined")
        if len(left) + len(right) > LONGEST_SEQUENCE:
            raise TooLarge(f"a sequence of {len(left) + len(right)} entries")


def check_repeated(left: Any, right: Any) -> None:
    for one, times in ((left, right), (right, left)):
        if isinstance(one, SEQUENCES) and isinstance(times, INTEGERS) and len(one) * int(times) > LONGEST_SEQUENCE:
            raise TooLarge(f"a sequence of {len(one)} entries, {times} times")
    if isinstance(left, int) and isinstance(right, int) and left.bit_length() + right.bit_length() > LARGEST_BITS:
        raise TooLarge("a product of huge integers")


def check_power(base: Any, exponent: Any) -> None:
    if isinstance(base, int) and isinstance(exponent, int) and base.bit_length() * abs(exponent) > LARGEST_BITS:
        raise TooLarge("a power of integers")


CHECKED = {"add": check_joined, "multiply": check_repeated, "power": check_power}

OPERATORS: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]] = {
    "add": (operator.add, operator.iadd),
    "subtract": (operator.sub, operator.isub),
    "multiply": (operator.mul, operator.imul),
    "divide": (operator.truediv, operator.itruediv),
    "floor_divide": (operator.floordiv, operator.ifloordiv),
    "remainder": (operator.mod, operator.imod),
    "power": (operator.pow, operator.ipow),
    "matmul": (operator.matmul, operator.imatmul),
    "and": (operator.and_, operator.iand),
    "or": (operator.or_, operator.ior),
    "xor": (operator.xor, operator.ixor),
}
"""Each operator, and what it does in place."""


def guarded(name: str, function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """An operator that lets nothing grow without bound."""
    check = CHECKED.get(name, lambda left, right: None)

    def call(left: Any, right: Any) -> Any:
        check(left, right)
        return numbers(function(left, right))

    return call


GUARDED = {
    ast.Add: "add",
    ast.Sub: "subtract",
    ast.Mult: "multiply",
    ast.Div: "divide",
    ast.FloorDiv: "floor_divide",
    ast.Mod: "remainder",
    ast.Pow: "power",
    ast.MatMult: "matmul",
    ast.BitAnd: "and",
    ast.BitOr: "or",
    ast.BitXor: "xor",
}


def called(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def named(name: str, value: ast.expr) -> ast.NamedExpr:
    return ast.NamedExpr(ast.Name(name, ast.Store()), value)


def sliced(index: ast.expr) -> ast.expr:
    """An index as a value: `1:2` is one only between brackets."""
    if isinstance(index, ast.Slice):
        ends = [end or ast.Constant(None) for end in (index.lower, index.upper, index.step)]
        return ast.copy_location(called("$slice", *ends), index)
    if isinstance(index, ast.Tuple):
        return ast.copy_location(ast.Tuple([sliced(one) for one in index.elts], ast.Load()), index)
    return index


class Rewrite(ast.NodeTransformer):
    """The syntax tree of what is run, from that of what was written. Lines stay where they are."""

    def program(self, tree: ast.Module) -> ast.Module:
        body = [one for node in tree.body if (one := self.visit(node)) is not None]
        body.append(ast.Return(ast.Name(NAME, ast.Load())))
        whole = ast.parse("def program(): pass")
        function = whole.body[0]
        assert isinstance(function, ast.FunctionDef)
        function.name, function.body = "$program", body
        return whole

    def visit_Import(self, node: ast.Import) -> ast.stmt:
        return ast.copy_location(ast.Pass(), node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.stmt:
        return ast.copy_location(ast.Pass(), node)

    def visit_Expr(self, node: ast.Expr) -> ast.stmt:
        return ast.copy_location(ast.Pass(), node) if is_docstring(node) else self.generic_visit(node)  # type: ignore[return-value]

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.stmt:
        node.returns = None
        self.generic_visit(node)
        node.body.insert(0, ast.copy_location(ast.Expr(called("$burn")), node))
        return node

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.stmt:
        if node.value is None:
            return ast.copy_location(ast.Pass(), node)
        return ast.copy_location(ast.Assign([self.visit(node.target)], self.visit(node.value)), node)

    def visit_For(self, node: ast.For) -> ast.stmt:
        self.generic_visit(node)
        node.body.insert(0, ast.copy_location(ast.Expr(called("$burn")), node))
        return node

    def visit_comprehension(self, node: ast.comprehension) -> ast.comprehension:
        self.generic_visit(node)
        node.ifs.insert(0, ast.copy_location(called("$burn"), node.target))
        return node

    def visit_Lambda(self, node: ast.Lambda) -> ast.expr:
        self.generic_visit(node)
        node.body = ast.copy_location(ast.BoolOp(ast.And(), [called("$burn"), node.body]), node)
        return node

    def visit_GeneratorExp(self, node: ast.GeneratorExp) -> ast.expr:
        self.generic_visit(node)
        return ast.copy_location(ast.ListComp(node.elt, node.generators), node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        return ast.copy_location(called(f"${GUARDED[type(node.op)]}", node.left, node.right), node)

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.stmt:
        self.generic_visit(node)
        old = copy.copy(node.target)
        old.ctx = ast.Load()
        if isinstance(old, ast.Subscript) and isinstance(node.target, ast.Subscript):
            # What is indexed, and by what, is computed once, when the old value is read.
            old.value, old.slice = named("$target", old.value), named("$index", sliced(old.slice))
            node.target.value, node.target.slice = ast.Name("$target", ast.Load()), ast.Name("$index", ast.Load())
        new = called(f"$i{GUARDED[type(node.op)]}", old, node.value)
        return ast.copy_location(ast.Assign([node.target], new), node)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        name, method = dotted(node.func), node.func.attr if isinstance(node.func, ast.Attribute) else ""
        self.generic_visit(node)
        if name in CALLED_TYPES:
            node.func = ast.Name(f"{name}()", ast.Load())
        elif name is None and method in ("keys", "items", "values"):
            return ast.copy_location(called("$list", node), node)  # views of keys make sets, whose order is chance
        elif name is None and method == "extend":
            assert isinstance(node.func, ast.Attribute)
            return ast.copy_location(called("$extend", node.func.value, *node.args), node)
        for keyword in node.keywords:
            if keyword.arg == "out":
                keyword.value = ast.copy_location(called("$array", keyword.value), node)
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        name = dotted(node)
        if name is not None:
            return ast.copy_location(ast.Name(name, ast.Load()), node)
        if node.attr == "dtype":
            return ast.copy_location(called("$dtype", self.visit(node.value)), node)
        return self.generic_visit(node)  # type: ignore[return-value]

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.copy_location(ast.Name("$range", ast.Load()), node) if node.id == "range" else node
