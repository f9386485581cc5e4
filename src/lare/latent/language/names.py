"""What a source says of its factors: their names, and what the comments above them say they mean."""

import ast
import itertools
import re
import threading
import warnings

from lare.latent.language.allowed import NAME

NUMBERING = re.compile(r"^(factor\s*)?\d+\s*[.:)]\s*", re.IGNORECASE)

ONE_AT_A_TIME = threading.Lock()
"""Candidates are examined in threads, and before Python 3.11.8 and 3.12.2 two parsers may lose count of how deep they are: a
SystemError, where the garbage collector lets another thread go on (python/cpython#106905)."""


def names_of(source: str, size: int) -> list[str]:
    """A name for each factor; a number where the source gives none."""
    names = factor_names(source)
    return names if names and len(names) == size else [f"factor_{number}" for number in range(1, size + 1)]


def parsed(source: str) -> ast.Module:
    """The tree of a source that has passed. What Python would warn of is not for here."""
    with ONE_AT_A_TIME, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ast.parse(source)


def factor_names(source: str) -> list[str] | None:
    """The names in the list that the function returns, or None where they cannot be read off."""
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.FunctionDef) and node.name == NAME and isinstance(node.body[-1], ast.Return):
            returned = node.body[-1].value
            if isinstance(returned, ast.List | ast.Tuple):
                return [
                    item.id if isinstance(item, ast.Name) else f"factor_{number}"
                    for number, item in enumerate(returned.elts, start=1)
                ]
    return None


def factor_meanings(source: str) -> dict[str, str]:
    """How a model explains its factors: for each variable, the comment right above its assignment.

    A factor that is worked out over several lines may have its comment, then with a number, above the first of them.
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
    """The comment that some lines begin with."""
    texts = (line.strip().lstrip("#").strip() for line in itertools.takewhile(is_comment, lines))
    return " ".join(texts)
