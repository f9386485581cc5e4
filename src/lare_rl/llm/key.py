"""The key of a model: read from the environment, sent in the header of a request, and removed from every text that is kept."""

import functools
import os
import re

VARIABLE = "OPENAI_API_KEY"

SHORTEST = 8
"""The fewest characters of a key that is removed from texts. A shorter one is not a secret, but a word like "none"."""


def key() -> str:
    return os.environ.get(VARIABLE, "").strip()


def without_key(text: str) -> str:
    """A text without the key, whether it is written literally or by the escapes of JSON and Python."""
    secret = key()
    return spellings(secret).sub("[key]", text) if len(secret) >= SHORTEST else text


@functools.lru_cache(maxsize=8)
def spellings(secret: str) -> re.Pattern[str]:
    """A pattern of all texts that become the key when their escapes are read, once or twice."""
    return re.compile("".join(spelled(letter) for letter in secret))


def spelled(letter: str) -> str:
    code = ord(letter)
    numbers = rf"[uU](?:0000)?00(?i:{code:02x})|[uU]\{{?0*(?i:{code:x})\}}|x(?i:{code:02x})|0?{code:o}"
    return rf"\\{{0,4}}(?:{re.escape(letter)}|(?<=\\)(?:{numbers}))"
