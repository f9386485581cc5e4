"""How the arguments of a call become the names of a function of the program."""

import ast
from collections.abc import Mapping, Sequence
from typing import Any

from lare_rl.phi.values import Function


def bind_arguments(function: Function, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of each parameter: its argument, or its default if there is none."""
    parameters = function.parameters
    positional = [parameter.arg for parameter in (*parameters.posonlyargs, *parameters.args)]
    values = dict(zip(positional[len(positional) - len(function.defaults) :], function.defaults, strict=True))
    keyword_only = [parameter.arg for parameter in parameters.kwonlyargs]
    defaults = zip(keyword_only, parameters.kw_defaults, function.keyword_defaults, strict=True)
    values |= {name: value for name, node, value in defaults if node is not None}
    if len(args) > len(positional) and parameters.vararg is None:
        raise TypeError(f"{function.name} takes {len(positional)} arguments, and {len(args)} were given")
    values |= dict(zip(positional, args, strict=False))
    rest = dict(kwargs)
    for name in [*positional, *keyword_only]:
        if name in rest:
            values[name] = rest.pop(name)
        if name not in values:
            raise TypeError(f"{function.name} needs the argument {name!r}")
    if parameters.vararg is not None:
        values[parameters.vararg.arg] = tuple(args[len(positional) :])
    if parameters.kwarg is not None:
        values[parameters.kwarg.arg] = rest
    elif rest:
        raise TypeError(f"{function.name} has no argument {next(iter(rest))!r}")
    return values


def has_yield(body: Sequence[ast.stmt] | ast.expr) -> bool:
    """Whether the body of a function has a `yield` of its own."""
    rest: list[ast.AST] = list(body) if isinstance(body, list) else []
    while rest:
        node = rest.pop()
        if isinstance(node, (ast.Yield, ast.YieldFrom)):
            return True
        if not isinstance(node, (ast.FunctionDef, ast.Lambda, ast.ClassDef)):
            rest.extend(ast.iter_child_nodes(node))
    return False
