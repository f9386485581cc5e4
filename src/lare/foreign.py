"""Reading what somebody else may have written: texts of a bounded size, JSON and TOML of a bounded depth.

Everything that is read back goes through here, our own files too: they may be damaged, or another's.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from lare.errors import LareError

DEEPEST = 64
"""Objects within objects."""

MOST_DIGITS = 1000
"""Of a whole number. Python itself gives up at 4300, with advice that is for programmers."""

DOTS = re.compile(rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST}}}""")
"""A name of a table within tables, for which the parser takes quadratic time."""

LARGEST_TEXT = 64 << 20
"""Bytes of a file that holds texts: a recording of a hundred long replies has as many."""

LARGEST_SETTINGS = 1 << 20
"""Bytes of a file that somebody wrote by hand."""


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """A file's text. Raises `LareError` where it has none, or more than it may."""
    try:
        if path.exists() and not path.is_file():
            raise LareError(f"{path} is not a file")
        with path.open("rb") as file:
            content = file.read(largest + 1)
        if len(content) > largest:
            raise LareError(f"{path} is larger than {largest >> 20} MB")
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, UnicodeDecodeError) as error:
        raise LareError(f"{path} cannot be read: {error}") from error


def read_json(text: str | bytes, strict: bool = True) -> Any:
    """What a text says in JSON. Raises `ValueError` where it says nothing, or is nested too deep.

    Args:
        strict: without it, lines may end within a string.
    """
    try:
        return shallow(json.loads(text, strict=strict, parse_int=integer))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def read_toml(text: str) -> dict[str, Any]:
    """What a text says in TOML. Raises `ValueError` as `read_json`."""
    if DOTS.search(text):
        raise ValueError(TOO_DEEP)
    try:
        return shallow(tomllib.loads(text))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


TOO_DEEP = f"it is nested more than {DEEPEST} deep"


def shallow(value: Any) -> Any:
    """The value. Raises `ValueError` where it is nested too deep for whoever walks through it."""
    level = [value]
    for _ in range(DEEPEST):
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return value
    raise ValueError(TOO_DEEP)


def integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)
