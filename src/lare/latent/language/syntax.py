"""Reading syntax trees: what a program defines, binds and names."""

import ast
import inspect
import math
from collections.abc import Iterator

import numpy as np

from lare.latent.language.allowed import KEY, MODULES

Function = ast.FunctionDef | ast.Lambda


def definitions(tree: ast.Module) -> list[tuple[str, Function]]:
    """Every function of a program with its name, whether by `def` or as `name = lambda ...`."""
    found: list[tuple[str, Function]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            found.append((node.name, node))
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Lambda):
            found += [(target.id, node.value) for target in node.targets if isinstance(target, ast.Name)]
    return found


def is_name(node: ast.AST, *names: str) -> bool:
    return isinstance(node, ast.Name) and (not names or node.id in names)


def assigned(node: ast.AST) -> set[str]:
    """Names that a function or module binds, without those that are bound inside its inner functions."""
    found: set[str] = set()
    frontier = list(ast.iter_child_nodes(node))
    while frontier:
        inner = frontier.pop()
        if isinstance(inner, ast.Name) and not isinstance(inner.ctx, ast.Load):
            found.add(inner.id)
        if isinstance(inner, ast.ExceptHandler) and inner.name:
            found.add(inner.name)
        if isinstance(inner, ast.FunctionDef):
            found.add(inner.name)
        elif not isinstance(inner, ast.Lambda):
            frontier += ast.iter_child_nodes(inner)
    return found


def evaluated(node: ast.AST) -> Iterator[ast.AST]:
    """A node and everything below it except annotations, which are never evaluated."""
    yield node
    for name, value in ast.iter_fields(node):
        if name not in {"annotation", "returns"}:
            for inner in value if isinstance(value, list) else [value]:
                if isinstance(inner, ast.AST):
                    yield from evaluated(inner)


def beneath(node: ast.AST) -> Iterator[ast.AST]:
    """Statements, expressions and comprehensions directly below a node, and the statements of its exception handlers."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.stmt | ast.expr | ast.comprehension):
            yield inner
        elif isinstance(inner, ast.ExceptHandler):
            yield from inner.body


def rebound(function: ast.FunctionDef) -> set[str]:
    """Names that a function rebinds, so that they may no longer refer to its inputs."""
    changed = {id(node.target) for node in ast.walk(function) if isinstance(node, ast.AugAssign)}
    return {
        node.id
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and id(node) not in changed
    }


def parameters(arguments: ast.arguments) -> set[str]:
    return {one.arg for one in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]}


def dotted(node: ast.AST) -> str | None:
    """`numpy.linalg.norm` for `np.linalg.norm`; None if an expression is not a dotted name of a module."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.insert(0, node.attr)
        node = node.value
    if parts and isinstance(node, ast.Name) and node.id in MODULES:
        return ".".join([MODULES[node.id], *parts])
    return None


def shown(name: str) -> str:
    """A dotted name as programs usually write it: `np.abs` for `numpy.abs`."""
    return name.replace("numpy.", "np.", 1)


def is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def is_string(node: ast.AST, among: frozenset[str] | set[str]) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in among


def is_singleton(node: ast.AST) -> bool:
    """Whether a node is the literal None, True or False."""
    return isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, bool))


def is_key(value: object) -> bool:
    return isinstance(value, str) and KEY.fullmatch(value) is not None


def is_number(node: ast.AST) -> bool:
    """Whether a node is a literal number (possibly with a sign), a truth value or None, or a tuple of these."""
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.USub | ast.UAdd) and is_number(node.operand)
    if isinstance(node, ast.Tuple):
        return all(is_number(one) for one in node.elts)
    return isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, int | float))


def exists(name: str) -> bool:
    """Whether a dotted name exists, as far as this can be determined without loading modules."""
    module, *parts = name.split(".")
    value: object = {"numpy": np, "math": math}[module]
    for part in parts:
        if value is None or part.startswith("_"):
            return True  # unknown, because it is private or not loaded yet
        if part not in dir(value):
            return False
        value = inspect.getattr_static(value, part, None)
    return True
