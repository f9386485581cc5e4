"""Reading files that somebody else may have written: texts of a bounded size, JSON and TOML of a bounded depth.

Files that LaRe wrote are read by these functions too: they may be damaged, or come from somebody else.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError

DEEPEST = 64
"""The largest depth of objects within objects."""

MOST_DIGITS = 1000
"""The most digits of a whole number. Python's own limit is 4300, and its message is for programmers."""

DOTS = re.compile(rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST}}}""")
"""A name of deeply nested tables, for which the parser takes quadratic time."""

LARGEST_TEXT = 64 << 20
"""The largest size in bytes of a file of texts, such as a recording of a hundred long replies."""

LARGEST_SETTINGS = 1 << 20
"""The largest size in bytes of a file that is written by hand."""


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """A file's text. Raises `LareError` if it cannot be read, or is larger than `largest`."""
    try:
        if path.exists() and not path.is_file():
            raise LareError(f"{path} is not a file")
        with path.open("rb") as file:
            content = file.read(largest + 1)
        if len(content) > largest:
            raise LareError(f"{path} is larger than {largest >> 20} MB")
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise LareError(f"{path} cannot be read: {reason}") from error


def read_json(text: str | bytes, strict: bool = True) -> Any:
    """The value of a JSON text. Raises `ValueError` if it is not JSON, or is nested too deep.

    Args:
        strict: if false, a string may contain line breaks.
    """
    try:
        return shallow(json.loads(text, strict=strict, parse_int=integer))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def read_toml(text: str) -> dict[str, Any]:
    """The value of a TOML text. Raises `ValueError` like `read_json`."""
    if DOTS.search(text):
        raise ValueError(TOO_DEEP)
    try:
        return shallow(tomllib.loads(text))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


TOO_DEEP = f"it is nested more than {DEEPEST} deep"


def shallow(value: Any) -> Any:
    """The value. Raises `ValueError` if it is nested too deep for recursive functions."""
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
