"""Texts that are safe to show: without characters that control the terminal, and without invisible ones."""

import re
import unicodedata

__all__ = [
    "NAME_RULE",
    "first_invisible",
    "is_name",
    "last_line",
    "one_line",
    "replace_surrogates",
    "sanitize",
]

MAX_NAME_LENGTH = 80
NAME_RULE = f"a text of 1 to {MAX_NAME_LENGTH} visible characters, without line breaks, and with single spaces between words only"
"""The rule of `is_name`, for messages."""

# Invisible letters and marks (Default_Ignorable_Code_Point), and the empty Braille pattern.
_FILLERS = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\U0001bca0-\U0001bca3\U000e0000-\U000e0fff]"
)
# Control, format, private use, surrogate, unassigned, line separator, paragraph separator.
_INVISIBLE_CATEGORIES = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})


def last_line(text: str) -> str:
    """Return the last line of a text that is not blank, without white space at its end."""
    return text.strip().rpartition("\n")[2]


def sanitize(text: str) -> str:
    """Replace control and invisible characters by `?`, except line breaks and tabs."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(letter if _is_visible(letter) else "?" for letter in text)


def one_line(text: object) -> str:
    """Sanitize a text, and write it in one line."""
    return sanitize(" ".join(str(text).split()))


def is_name(value: object) -> bool:
    """Return whether a value can be the name of a number in tables and messages: see `NAME_RULE`."""
    return isinstance(value, str) and 0 < len(value) <= MAX_NAME_LENGTH and value == one_line(value)


def replace_surrogates(text: str) -> str:
    """Replace each half of a surrogate pair by `?`. JSON can express a half, but UTF-8 cannot."""
    return text.encode(errors="replace").decode()


def first_invisible(text: str) -> int | None:
    """Return the index of the first control or invisible character, except line breaks and tabs, or None."""
    if text.isascii() and text.replace("\n", "").replace("\t", "").isprintable():
        return None
    return next((index for index, letter in enumerate(text) if not _is_visible(letter)), None)


def _is_visible(letter: str) -> bool:
    is_invisible = unicodedata.category(letter) in _INVISIBLE_CATEGORIES or _FILLERS.match(letter)
    return letter in "\n\t" or not is_invisible
