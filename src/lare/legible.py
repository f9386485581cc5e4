"""Texts for a person's eyes: nothing that steers the terminal, and nothing that nobody sees."""

import re
import unicodedata

FILLERS = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\U0001bca0-\U0001bca3\U000e0000-\U000e0fff]"
)
"""Letters and marks by their category, that show nothing (Default_Ignorable_Code_Point, and the empty Braille pattern)."""

UNSEEN = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Categories: controls, formats, private use, half characters, what is not assigned, separators of lines and paragraphs."""


def is_seen(letter: str) -> bool:
    """Whether a letter shows as something, or is a common space."""
    return letter in "\n\t" or (unicodedata.category(letter) not in UNSEEN and not FILLERS.match(letter))


def unseen(text: str) -> int | None:
    """The place of the first letter that nobody sees; None where there is none."""
    if text.isascii() and text.isprintable():
        return None
    return next((place for place, letter in enumerate(text) if not is_seen(letter)), None)


def legible(text: str) -> str:
    """The text with `?` for whatever would steer a terminal or hide: some of what is printed a stranger has said."""
    return text if text.isascii() and text.isprintable() else "".join(one if is_seen(one) else "?" for one in text)


def in_a_line(text: object) -> str:
    """The same, without ends of lines."""
    return legible(" ".join(str(text).split()))
