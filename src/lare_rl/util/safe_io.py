"""Reading of untrusted files: texts of a bounded size, JSON and TOML of a bounded depth.

These functions read the files of LaRe too, which may be damaged, or come from another person.
"""

import json
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from lare_rl.errors import LareError

__all__ = [
    "MAX_DEPTH",
    "MAX_SETTINGS_BYTES",
    "check_depth",
    "open_file",
    "parse_integer",
    "read_json",
    "read_json_object",
    "read_table",
    "read_text",
    "read_toml",
]

MAX_DEPTH = 64
"""The largest depth of objects within objects."""
MAX_TEXT_BYTES = 64 << 20
"""The largest size of a file of texts, such as a recording of a hundred long replies."""
MAX_SETTINGS_BYTES = 1 << 20
"""The largest size of a file that is written by hand."""
_MAX_DIGITS = 1000
"""The most digits of a whole number in JSON. Python's limit is 4300, and its message is for programmers."""
_TOO_DEEP = f"it is nested more than {MAX_DEPTH} deep"

_TOML_TEXT = re.compile(r'''"""(?:[^\\]|\\[\s\S])*?"""|\'\'\'[\s\S]*?\'\'\'|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+'|#[^\n]*+''')
"""A string or a comment of TOML."""

_DEEP_NAME = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MAX_DEPTH}}}")
"""A dotted name (`a.b.c`) of more than `MAX_DEPTH` parts without quotes. TOML's parser takes quadratic time for such a name."""


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for reading. Raises `LareError` for an `OSError` or a `ValueError` until it is closed."""
    try:
        if path.exists() and not path.is_file():
            raise LareError(f"{path} is not a file")
        with path.open("rb") as file:
            yield file
    except (OSError, ValueError) as error:  # a path may hold a null character
        raise LareError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    r"""Read a text file in UTF-8. Lines of the result end with \n.

    Raises `LareError` if the file cannot be read, or is too large.
    """
    with open_file(path) as file:
        content = file.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise LareError(f"{path} is larger than {max_bytes >> 20} MB")
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def read_json(text: str | bytes, strict: bool = True) -> Any:
    """Parse a JSON text, whose strings may contain line breaks if not `strict`.

    Raises `ValueError` if the text is not JSON, or is nested too deep.
    """
    try:
        return check_depth(json.loads(text, strict=strict, parse_int=parse_integer))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def read_json_object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object. Raises `ValueError` as `read_json` does, and if the text is no object."""
    value = read_json(text)
    if not isinstance(value, dict):
        raise ValueError("it is not an object")
    return value


def read_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text. Raises `ValueError` if the text is not TOML, or is nested too deep."""
    if _DEEP_NAME.search(_TOML_TEXT.sub("text", text)):
        raise ValueError(_TOO_DEEP)
    try:
        return check_depth(tomllib.loads(text))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError as error:
        hint = "; a text needs quotes" if str(error).startswith("Invalid value") else ""
        raise ValueError(f"{error}{hint}") from error


def read_table(path: Path, max_bytes: int = MAX_SETTINGS_BYTES) -> dict[str, Any]:
    """Read a file of settings: JSON if its name ends with .json, else TOML.

    Raises `LareError` if the file cannot be read, or is no table.
    """
    text, is_json = read_text(path, max_bytes), path.suffix == ".json"
    try:
        return read_json_object(text) if is_json else read_toml(text)
    except ValueError as error:
        raise LareError(f"{path}: it is not valid {'JSON' if is_json else 'TOML'}: {error}") from error


def check_depth(value: Any) -> Any:
    """Return a value. Raises `ValueError` if it is nested too deep for recursive functions."""
    level = [value]
    for _ in range(MAX_DEPTH + 1):
        containers = [x.values() if isinstance(x, dict) else x for x in level if isinstance(x, dict | list)]
        if not containers:
            return value
        level = [item for container in containers for item in container]
    raise ValueError(_TOO_DEEP)


def parse_integer(digits: str) -> int:
    """Parse a whole number. Raises `ValueError` if it has too many digits."""
    n_digits = len(digits.lstrip("-"))
    if n_digits > _MAX_DIGITS:
        raise ValueError(f"a number has {n_digits:,} digits (at most {_MAX_DIGITS:,} are read)")
    return int(digits)
