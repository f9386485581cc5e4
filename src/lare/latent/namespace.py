"""The names that generated code may use, and turning its source into a function.

The same in the process that verifies a function and in the one that later runs it, so that what passed there runs here.
A short list of names is no boundary against hostile code, only a plain one against careless code: nothing is compiled
here that `verify` has not passed.
"""

import ast
import builtins
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

NAME = "evaluation_func"
"""What a reply must call its function."""

MODULES = ("numpy", "math")

BUILTINS = (
    "abs all any bool dict enumerate float int isinstance len list map max min pow range reversed round sorted sum "
    "tuple zip ValueError"
).split()


NUMBERING = re.compile(r"^(factor\s*)?\d+\s*[.:)]\s*", re.IGNORECASE)


def imported(name: str, *rest: Any) -> Any:
    # NumPy's own C code imports parts of itself through its caller's __import__, at the first `x.mean()`.
    if name.partition(".")[0] not in MODULES:
        raise ImportError(f"only numpy and math can be imported, not {name}")
    return __import__(name, *rest)


def normal(source: str) -> str:
    """The source as it is kept: line ends of one kind, no blank lines around it."""
    return "\n".join(source.splitlines()).strip("\n")


def compile_function(source: str) -> Callable[[np.ndarray, np.ndarray], Any]:
    """The function that `source` defines.

    Raises:
        SyntaxError: `source` is not Python.
        NameError: it defines no `evaluation_func`.
    """
    allowed = {name: getattr(builtins, name) for name in BUILTINS}
    namespace: dict[str, Any] = {"__builtins__": {**allowed, "__import__": imported}, "np": np, "math": math}
    exec(compile(source, "latent_function.py", "exec"), namespace)
    if not callable(namespace.get(NAME)):
        raise NameError(f"the code defines no function {NAME}(observation, action)")
    return namespace[NAME]


def factor_names(source: str) -> list[str] | None:
    """The names in the list that the function returns, or None where they cannot be read off."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and node.name == NAME and isinstance(node.body[-1], ast.Return):
            returned = node.body[-1].value
            if isinstance(returned, ast.List | ast.Tuple):
                return [
                    item.id if isinstance(item, ast.Name) else f"factor_{number}"
                    for number, item in enumerate(returned.elts, start=1)
                ]
    return None


def factor_meanings(source: str) -> dict[str, str]:
    """For each variable, the comment right above its assignment: how a model explains its factors."""
    lines = source.splitlines()
    meanings = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            comment = []
            number = node.lineno - 2
            while number >= 0 and lines[number].strip().startswith("#"):
                comment.insert(0, lines[number].strip().lstrip("#").strip())
                number -= 1
            if comment:
                meanings[node.targets[0].id] = NUMBERING.sub("", " ".join(comment))
    return meanings
