"""Compiles a source that has passed the gate. Names are bound only to what `allowed.py` lists, and loop iterations are counted.

The program is simplified (`simplify.py`) and rewritten to the body of one function, with these changes:

* Dotted names such as `np.sum` become single names that no source can contain, so that no module is accessible.
* Operators become calls (`$add`), so that they can be guarded.
* The entries of values are counted before the values are compared or hashed.
* Imports, annotations and docstrings are removed. Generators become lists.
* Loops, comprehensions and calls consume fuel.

Line numbers stay the same. The whole function is run at each call, so that no state passes from one call to the next. Its names
are bound to guarded functions of Python and NumPy (`guards.py`), and to nothing else.
"""

import ast
import builtins
import copy
import functools
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lare.latent.language.allowed import BUILTINS, CONSTANTS, DOTTED, DTYPES, METHODS, NAME
from lare.latent.language.guards import (
    FUEL,
    OPERATORS,
    array_only,
    at_once,
    bounded,
    dtype_of,
    extend,
    few,
    guarded,
    numbers,
    of_few,
    only_numbers,
    rounded,
    size,
    total,
)
from lare.latent.language.simplify import simplified
from lare.latent.language.syntax import dotted, is_docstring

CALLED_TYPES = frozenset(f"numpy.{name}" for name in DTYPES)
"""Types that are called as functions too: `np.float32(x)`."""

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
    """An index as an expression. `1:2` is only valid between brackets, and becomes a call of `slice`."""
    if isinstance(index, ast.Slice):
        ends = [end or ast.Constant(None) for end in (index.lower, index.upper, index.step)]
        return ast.copy_location(called("$slice", *ends), index)
    if isinstance(index, ast.Tuple):
        return ast.copy_location(ast.Tuple([sliced(one) for one in index.elts], ast.Load()), index)
    return index


def looked_into(node: ast.expr) -> ast.expr:
    """Count the entries of a value before it is compared or hashed. Literals need no check."""
    return node if isinstance(node, ast.Constant) else ast.copy_location(called("$few", node), node)


def looked_up(index: ast.expr) -> ast.expr:
    """The same check for an index, which may be the key of a dictionary."""
    if isinstance(index, ast.Tuple):
        return ast.copy_location(ast.Tuple([looked_up(one) for one in index.elts], ast.Load()), index)
    return index if isinstance(index, ast.Slice) else looked_into(index)


class Rewrite(ast.NodeTransformer):
    """Rewrites a tree that has passed the gate."""

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

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        self.generic_visit(node)
        node.left, node.comparators = looked_into(node.left), [looked_into(one) for one in node.comparators]
        return node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        self.generic_visit(node)
        node.slice = looked_up(node.slice)
        return node

    def visit_Dict(self, node: ast.Dict) -> ast.expr:
        self.generic_visit(node)
        node.keys = [key and looked_into(key) for key in node.keys]
        return node

    def visit_DictComp(self, node: ast.DictComp) -> ast.expr:
        self.generic_visit(node)
        node.key = looked_into(node.key)
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        return ast.copy_location(called(f"${GUARDED[type(node.op)]}", node.left, node.right), node)

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.stmt:
        self.generic_visit(node)
        old = copy.copy(node.target)
        old.ctx = ast.Load()
        if isinstance(old, ast.Subscript) and isinstance(node.target, ast.Subscript):
            # The target and the index are evaluated only once, when the old value is read.
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
            return ast.copy_location(called("$list", node), node)  # views of keys make sets, whose order is random
        elif name is None and method == "extend":
            assert isinstance(node.func, ast.Attribute)
            return ast.copy_location(called("$extend", node.func.value, *node.args), node)
        elif name is None and method in ("get", "pop", "repeat"):
            of = looked_into if method != "repeat" else lambda one: ast.copy_location(called("$size", one), one)
            node.args = [of(one) for one in node.args]
        for keyword in node.keywords:
            if keyword.arg == "out":
                keyword.value = ast.copy_location(called("$array", keyword.value), node)
        if name is None and method in METHODS:
            return ast.copy_location(called("$numbers", node), node)
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


FILE = "latent_function.py"
"""The file name of the program in tracebacks."""


class OutOfFuel(Exception):
    """The program made more loop iterations and calls than allowed."""


class Program:
    """A compiled program. `steps` is the fuel that the last call consumed."""

    def __init__(self, source: str, functions: Mapping[str, Any] | None = None):
        """Compile a source. `functions` replaces the functions behind dotted names, for calls on special arrays.

        Raises:
            SyntaxError: the source passed the gate but does not compile, such as `return` outside a function.
        """
        tree = ast.fix_missing_locations(Rewrite().program(simplified(ast.parse(source))))
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
    """All names that a program can use."""
    return dict(everything())


@functools.cache
def everything() -> dict[str, Any]:
    names: dict[str, Any] = {name: resolve(name) for name in DOTTED.keys() | CONSTANTS | {"numpy.errstate"}}
    names |= {
        name: only_numbers(names[name], name) for name in DOTTED if name.startswith("numpy.") and name not in CONSTANTS
    }
    names |= {f"{name}()": only_numbers(names[name], name) for name in CALLED_TYPES}
    names |= {name: getattr(builtins, name) for name in BUILTINS if name != "range"}  # `$range` replaces it
    for name, (plain, in_place) in OPERATORS.items():
        names |= {f"${name}": guarded(name, plain), f"$i{name}": guarded(name, in_place)}
    names |= {
        "$list": list,
        "$slice": slice,
        "$array": array_only,
        "$dtype": dtype_of,
        "$numbers": numbers,
        "$extend": extend,
        "$few": few,
        "$size": size,
        "round": rounded,
        "sum": total,
    }
    names |= {name: at_once(getattr(builtins, name)) for name in ("enumerate", "reversed", "zip")}
    names |= {name: of_few(getattr(builtins, name)) for name in "all any dict list max min sorted tuple".split()}
    # NumPy imports parts of itself through its caller's __import__, a name that no program can use.
    return {**names, "__builtins__": {"__import__": already_loaded}}


def resolve(name: str) -> Any:
    """The object that a dotted name of the language refers to."""
    module, *parts = name.split(".")
    value: Any = {"numpy": np, "math": math}[module]
    for part in parts:
        value = getattr(value, part)
    return value


def already_loaded(name: str, *rest: Any) -> Any:
    if name.partition(".")[0] == "numpy" and name in sys.modules:
        return sys.modules[name]
    raise ImportError(name)
