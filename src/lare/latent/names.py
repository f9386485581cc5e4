"""What a source says of its factors: their names, and what the comments above them say they mean."""

import ast
import re
import warnings

from lare.latent.language import NAME

NUMBERING = re.compile(r"^(factor\s*)?\d+\s*[.:)]\s*", re.IGNORECASE)


def names_of(source: str, size: int) -> list[str]:
    """A name for each factor; a number where the source gives none."""
    names = factor_names(source)
    return names if names and len(names) == size else [f"factor_{number}" for number in range(1, size + 1)]


def parsed(source: str) -> ast.Module:
    """The tree of a source that has passed. What Python would warn of is not for here."""
    with warnings.catch_warnings():
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
    """For each variable, the comment right above its assignment: how a model explains its factors."""
    lines = source.splitlines()
    meanings = {}
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            comment = []
            number = node.lineno - 2
            while number >= 0 and lines[number].strip().startswith("#"):
                comment.insert(0, lines[number].strip().lstrip("#").strip())
                number -= 1
            if comment:
                meanings[node.targets[0].id] = NUMBERING.sub("", " ".join(comment))
    return meanings
