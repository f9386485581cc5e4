"""The key of a model: read from the environment, sent in the header of a request, and taken out of every text that is kept."""

import functools
import os
import re

VARIABLE = "OPENAI_API_KEY"

SHORTEST = 8
"""Characters of a key that is looked for. What is shorter is no secret, but a word like "none"."""


def key() -> str:
    return os.environ.get(VARIABLE, "").strip()


def without_key(text: str) -> str:
    """A text without the key, whoever put it there, as it is or spelled by the escapes of JSON and Python."""
    secret = key()
    return spellings(secret).sub("[key]", text) if len(secret) >= SHORTEST else text


@functools.lru_cache(maxsize=8)
def spellings(secret: str) -> re.Pattern[str]:
    """What becomes the key when escapes are read, once or twice over."""
    return re.compile("".join(spelled(letter) for letter in secret))


def spelled(letter: str) -> str:
    code = ord(letter)
    numbers = rf"[uU](?:0000)?00(?i:{code:02x})|[uU]\{{?0*(?i:{code:x})\}}|x(?i:{code:02x})|0?{code:o}"
    return rf"\\{{0,4}}(?:{re.escape(letter)}|(?<=\\)(?:{numbers}))"
