"""Reading syntax trees: what a program defines, binds and names."""

import ast

import numpy as np

from lare.latent.language import KEY, MODULES

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
    """Names that a function (or the module) binds itself, functions within it apart."""
    found: set[str] = set()
    frontier = list(ast.iter_child_nodes(node))
    while frontier:
        inner = frontier.pop()
        if isinstance(inner, ast.Name) and not isinstance(inner.ctx, ast.Load):
            found.add(inner.id)
        if isinstance(inner, ast.FunctionDef):
            found.add(inner.name)
        elif not isinstance(inner, ast.Lambda):
            frontier += ast.iter_child_nodes(inner)
    return found


def rebound(function: ast.FunctionDef) -> set[str]:
    """Names that a function gives another value, so that they need not mean its inputs any more."""
    changed = {id(node.target) for node in ast.walk(function) if isinstance(node, ast.AugAssign)}
    return {
        node.id
        for node in ast.walk(function)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and id(node) not in changed
    }


def parameters(arguments: ast.arguments) -> set[str]:
    return {one.arg for one in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]}


def dotted(node: ast.AST) -> str | None:
    """`numpy.linalg.norm` of `np.linalg.norm`; None where an expression is not a dotted name of a module."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.insert(0, node.attr)
        node = node.value
    if parts and isinstance(node, ast.Name) and node.id in MODULES:
        return ".".join([MODULES[node.id], *parts])
    return None


def shown(name: str) -> str:
    """A dotted name as people write it."""
    return name.replace("numpy.", "np.", 1)


def is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def is_string(node: ast.AST, among: frozenset[str] | set[str]) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in among


def is_key(value: object) -> bool:
    return isinstance(value, str) and KEY.fullmatch(value) is not None


def is_number(node: ast.AST) -> bool:
    """A number (perhaps with a sign), a truth value or None, or a tuple of them."""
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.USub | ast.UAdd) and is_number(node.operand)
    if isinstance(node, ast.Tuple):
        return all(is_number(one) for one in node.elts)
    return isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, int | float))


def exists(name: str) -> bool:
    """Whether NumPy has something of that name. Looks only at what is loaded already."""
    value: object = np
    for part in name.split(".")[1:] if name.startswith("numpy.") else ():
        if part.startswith("_") or part not in vars(value):
            return False
        value = vars(value)[part]
        if not hasattr(value, "__dict__"):
            break
    return name.startswith("numpy.")
