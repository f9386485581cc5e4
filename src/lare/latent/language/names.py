"""Reads the names of factors from a source, and their meanings from the comments above them."""

import ast
import itertools
import re
import threading
import warnings

from lare.latent.language.allowed import NAME

NUMBERING = re.compile(r"^(factor\s*)?\d+\s*[.:)]\s*", re.IGNORECASE)

ONE_AT_A_TIME = threading.Lock()
"""Candidates are examined in threads. Before Python 3.11.8 and 3.12.2, parsers in two threads may miscount their recursion depth
and raise a SystemError, if the garbage collector switches threads (python/cpython#106905)."""


def names_of(source: str, size: int) -> list[str]:
    """A name for each factor: from the source, or else `factor_1` and so on."""
    names = factor_names(source)
    return names if names and len(names) == size else [f"factor_{number}" for number in range(1, size + 1)]


def parsed(source: str) -> ast.Module:
    """The syntax tree of a source that has passed the gate, without Python's warnings."""
    with ONE_AT_A_TIME, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ast.parse(source)


def factor_names(source: str) -> list[str] | None:
    """The names in the list that the function returns, or None if they cannot be determined."""
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.FunctionDef) and node.name == NAME and isinstance(node.body[-1], ast.Return):
            listed = written_out(node, node.body[-1].value)
            if listed is not None:
                return [
                    item.id if isinstance(item, ast.Name) else f"factor_{number}"
                    for number, item in enumerate(listed, start=1)
                ]
    return None


def written_out(function: ast.FunctionDef, returned: ast.expr | None) -> list[ast.expr] | None:
    """The items of a list or tuple that is written out: `[a, b]`, `factors`, or `[f.reshape(n, 1) for f in factors]`, where the
    function assigns `factors` once.
    """
    if isinstance(returned, ast.ListComp) and len(returned.generators) == 1 and not returned.generators[0].ifs:
        returned = returned.generators[0].iter
        returned = returned if isinstance(returned, ast.Name) else None
    if isinstance(returned, ast.Name):
        assigned = [
            node.value
            for node in ast.walk(function)
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name) and target.id == returned.id
        ]
        returned = assigned[0] if len(assigned) == 1 else None
    return returned.elts if isinstance(returned, ast.List | ast.Tuple) else None


def factor_meanings(source: str) -> dict[str, str]:
    """How a model explains its factors: for each variable, the comment directly above its assignment.

    If a factor is computed in several lines, its comment may be above the first of these lines, but must then be numbered.
    """
    lines, factors = source.splitlines(), factor_names(source) or []
    assigned = {
        node.lineno - 1: node.targets[0].id
        for node in ast.walk(parsed(source))
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    meanings, comment, numbered = {}, "", ""
    for number, line in enumerate(lines):
        if is_comment(line) and not (number and is_comment(lines[number - 1])):
            comment = read_comment(lines[number:])
            numbered = comment if NUMBERING.match(comment) else ""
        name = assigned.get(number)
        above = number and is_comment(lines[number - 1])
        if name is not None and (above or (name in factors and numbered)):
            meanings[name] = NUMBERING.sub("", comment)
        if name in factors:
            numbered = ""
    return meanings


def is_comment(line: str) -> bool:
    return line.strip().startswith("#")


def read_comment(lines: list[str]) -> str:
    """The comment at the start of the lines."""
    texts = (line.strip().lstrip("#").strip() for line in itertools.takewhile(is_comment, lines))
    return " ".join(texts)
