"""Tables in Markdown, and values as their cells."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from lare_rl.errors import CheckedModel

__all__ = ["code", "codes", "default", "docstring_text", "kind", "parameters", "table"]

NONE = "-"
"""The cell of a value that does not exist."""


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def parameters(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return a list of names, with notes in parentheses, and meanings."""
    return "\n".join(f"* {name} ({note}): {text}" if note else f"* {name}: {text}" for name, note, text in rows)


def code(text: str) -> str:
    return f"`{text}`"


def codes(names: Iterable[str]) -> str:
    return ", ".join(map(code, names))


def docstring_text(text: str | None) -> str:
    """Return a docstring as one line."""
    return " ".join((text or "").split())


def default(value: Any) -> str:
    """Return the default of a setting as a cell."""
    match value:
        case None:
            return NONE
        case float():
            return code(f"{value:g}")
        case tuple() | list() | dict() if not value:
            return NONE
        case tuple():
            return code(", ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in value))
        case _:
            return code(str(value))


KINDS = {str: "text", int: "whole number", float: "number", bool: "true or false", dict: "table"}


def kind(field: FieldInfo) -> str:
    """Return the kind of a field's values as a cell."""
    return " or ".join(_kinds(field.annotation))


def _kinds(annotation: Any) -> list[str]:
    arguments = get_args(annotation)
    if get_origin(annotation) is Literal:
        return [code(str(value)) for value in arguments]
    if get_origin(annotation) is Annotated:
        return _kinds(arguments[0])
    if get_origin(annotation) is tuple:
        return ["list of files" if issubclass(arguments[0], CheckedModel) else "list of texts"]
    if get_origin(annotation) is dict:
        return ["table"]
    if arguments:
        kinds = [name for argument in arguments if argument is not type(None) for name in _kinds(argument)]
        return list(dict.fromkeys(kinds))
    return ["table"] if issubclass(annotation, CheckedModel) else [KINDS[annotation]]
