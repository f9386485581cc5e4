"""The key of a model: read from the environment, sent in the header of a request, and removed from every text that is saved."""

import functools
import re

from lare_rl.util.variables import read_variable

__all__ = ["KEY_VARIABLE", "api_key", "redact_key"]

KEY_VARIABLE = "OPENAI_API_KEY"

_MIN_KEY_LENGTH = 8
"""A shorter key is not removed from texts, because it is not a secret but a word such as "none"."""


def api_key() -> str:
    """Return the key, or an empty text."""
    return read_variable(KEY_VARIABLE)


def redact_key(text: str) -> str:
    """Replace the key in a text, also where it is written by escapes of JSON or Python."""
    key = api_key()
    return _key_pattern(key).sub("[key]", text) if len(key) >= _MIN_KEY_LENGTH else text


@functools.lru_cache(maxsize=8)
def _key_pattern(key: str) -> re.Pattern[str]:
    """Return a pattern of all texts that become the key when their escapes are read once or twice."""
    return re.compile("".join(map(_letter_pattern, key)))


def _letter_pattern(letter: str) -> str:
    r"""Return a pattern of a letter and of its escapes, such as \u0041, \u{41}, \x41 and \101, after up to four backslashes."""
    code = ord(letter)
    escapes = rf"[uU](?:0000)?00(?i:{code:02x})|[uU]\{{?0*(?i:{code:x})\}}|x(?i:{code:02x})|0?{code:o}"
    return rf"\\{{0,4}}(?:{re.escape(letter)}|(?<=\\)(?:{escapes}))"
