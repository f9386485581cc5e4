"""The names of factors, and their meanings from the comments above them, read from the source."""

import ast
import itertools
import re
from collections.abc import Iterator, Sequence

from lare_rl.phi.limits import RefusedError
from lare_rl.phi.read import FUNCTION_NAME, parse

__all__ = ["factor_meanings", "factor_names"]

NUMBERING = re.compile(r"^(factor\s*)?\d+\s*[.:)]\s*", re.IGNORECASE)


def factor_names(source: str, count: int) -> list[str]:
    """Return a name for each factor: its variable in the list that the function returns, or else `factor_1` and so on.

    If two factors would have the same name, all are numbered.
    """
    numbered = [f"factor_{number}" for number in range(1, count + 1)]
    items = _returned_items(_parse_or_empty(source))
    if items is None or len(items) != count:
        return numbered
    names = [item.id if isinstance(item, ast.Name) else name for item, name in zip(items, numbered, strict=True)]
    return names if len(set(names)) == count else numbered


def factor_meanings(source: str, names: Sequence[str]) -> list[str]:
    """Return how the author explains each factor: the comment directly above its assignment, or an empty text.

    If a factor is computed in several lines, its comment may be above the first of them, but must then be numbered.
    """
    lines = source.split("\n")
    assigned = {line: name for name, line, _ in _assignments(_parse_or_empty(source))}
    meanings, comment, is_numbered = {}, "", False
    for index, line in enumerate(lines):
        follows_comment = index > 0 and _is_comment(lines[index - 1])
        if _is_comment(line) and not follows_comment:
            comment = _leading_comment(lines[index:])
            is_numbered = NUMBERING.match(comment) is not None
        name = assigned.get(index + 1)
        if name is not None and (follows_comment or (name in names and is_numbered)):
            meanings[name] = NUMBERING.sub("", comment)
        if name in names:
            is_numbered = False
    return [meanings.get(name, "") for name in names]


def _parse_or_empty(source: str) -> ast.Module:
    """Return the syntax tree of a source, or an empty one if it is refused."""
    try:
        return parse(source)
    except RefusedError:
        return ast.Module([], [])


def _assignments(tree: ast.AST) -> Iterator[tuple[str, int, ast.expr]]:
    """Yield the name, line and value of each assignment to a name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Name):
                    yield target.id, node.lineno, node.value


def _returned_items(tree: ast.Module) -> list[ast.expr] | None:
    """Return the items of the list that the function returns; None if the list is not written out.

    The list is `[a, b]`, or `factors` or `[f[:, None] for f in factors]`, if `factors` is assigned once.
    """
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == FUNCTION_NAME]
    if not functions or not isinstance(functions[-1].body[-1], ast.Return):
        return None
    returned = functions[-1].body[-1].value
    if isinstance(returned, ast.ListComp) and len(returned.generators) == 1 and not returned.generators[0].ifs:
        returned = returned.generators[0].iter
        returned = returned if isinstance(returned, ast.Name) else None
    if isinstance(returned, ast.Name):
        values = [value for name, _, value in _assignments(functions[-1]) if name == returned.id]
        returned = values[0] if len(values) == 1 else None
    return returned.elts if isinstance(returned, ast.List | ast.Tuple) else None


def _is_comment(line: str) -> bool:
    return line.strip().startswith("#")


def _leading_comment(lines: list[str]) -> str:
    """Return the comment at the start of the lines."""
    return " ".join(line.strip().lstrip("#").strip() for line in itertools.takewhile(_is_comment, lines))
