"""Texts that are safe to show: without characters that control the terminal, and without invisible ones."""

import re
import unicodedata

FILLERS = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\U0001bca0-\U0001bca3\U000e0000-\U000e0fff]"
)
"""Letters and marks by their category, but invisible (Default_Ignorable_Code_Point, and the empty Braille pattern)."""

UNSEEN = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Unicode categories: control, format, private use, surrogate, unassigned, line separator, paragraph separator."""


def is_seen(letter: str) -> bool:
    """Whether a character is visible, or is common white space."""
    return letter in "\n\t" or (unicodedata.category(letter) not in UNSEEN and not FILLERS.match(letter))


def unseen(text: str) -> int | None:
    """The index of the first invisible character; None if there is none."""
    if text.isascii() and text.replace("\n", "").replace("\t", "").isprintable():
        return None
    return next((place for place, letter in enumerate(text) if not is_seen(letter)), None)


def legible(text: str) -> str:
    """The text with `?` for control and invisible characters, because some printed texts come from strangers."""
    return text if text.isascii() and text.isprintable() else "".join(one if is_seen(one) else "?" for one in text)


def in_a_line(text: object) -> str:
    """The same, in one line."""
    return legible(" ".join(str(text).split()))
