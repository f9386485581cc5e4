"""The form of a model's reply, and its parser."""

import json
import re
from typing import Any

from pydantic import ConfigDict, Field

from lare_rl.errors import Checked, LareError
from lare_rl.llm.key import without_key
from lare_rl.util.safe_io import integer, read_json, shallow

LONGEST = 200_000
"""The most characters of a reply."""

MOST_STARTS = 100
"""In a text that is not a JSON object, at most so many places are tried as the beginning of one."""


class MalformedReply(LareError):
    """A reply that cannot be read. The message goes back to the model."""


class Reply(Checked):
    """The JSON object that a request asks for."""

    model_config = ConfigDict(extra="ignore")

    understand: str = Field(alias="Understand")
    analyze: str = Field(alias="Analyze")
    functions: str = Field(alias="Functions", min_length=1)
    """Source of `evaluation_func(observation, action)`."""


FENCE = re.compile(r"```[ \t]*+([\w.+-]*+)[ \t]*+\r?\n(.*?)```", re.DOTALL)
"""A fenced block, with its language."""

THOUGHT = re.compile(r"</think(?:ing)?>")
"""The end of the reasoning, which some models write before their answer and which may contain drafts of it."""

START = re.compile(r'\{\s*"')
"""A place where an object may begin."""

KEYS = {"Understand", "Analyze", "Functions"}


def parse(text: str) -> Reply:
    """Read a reply: one JSON object, bare, in a fence, or among other words; or else a fenced function.

    Raises:
        MalformedReply: with what was wrong.
    """
    if not text.strip():
        raise MalformedReply("the reply is empty")
    if len(text) > LONGEST:
        raise MalformedReply(f"the reply has {len(text)} characters; at most {LONGEST} are read")
    check_characters(text)
    try:
        values = read_json(text, strict=False)
    except ValueError as error:
        values = embedded(text)
        if values is None:
            raise MalformedReply(f"the reply is not one JSON object: {error}") from error
    if not isinstance(values, dict):
        raise MalformedReply(f"the reply is JSON, but not an object: {text.strip()[:40]!r}")
    try:
        reply = Reply(**values)
    except LareError as error:
        raise MalformedReply(f"the reply's JSON object is not as asked for: {error}") from error
    for part in (reply.understand, reply.analyze, reply.functions):
        check_characters(part)
    inner = FENCE.search(reply.functions)
    functions = reply.functions if inner is None or "def " in reply.functions[: inner.start()] else inner[2]
    texts = {"understand": reply.understand, "analyze": reply.analyze, "functions": functions}
    return reply.model_copy(update={name: without_key(text) for name, text in texts.items()})


def check_characters(text: str) -> None:
    """Raise `MalformedReply` if a text has a lone surrogate: JSON can express it, but no file can store it."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise MalformedReply(
            f"the reply holds {text[error.start]!a}, which is half a character (a surrogate)"
        ) from None


def embedded(text: str) -> dict[str, Any] | None:
    """The last complete object within a text, or else the function in a fenced block."""
    decoder, partial = json.JSONDecoder(strict=False, parse_int=integer), None
    text = THOUGHT.split(text)[-1]
    for start in [match.start() for match in START.finditer(text)][: -MOST_STARTS - 1 : -1]:
        try:
            value = shallow(decoder.raw_decode(text, start)[0])
        except (ValueError, RecursionError):
            continue
        if value.keys() >= KEYS:
            return value
        if "Functions" in value:
            partial = value
    if partial is not None:
        return partial
    for fence in FENCE.finditer(text):
        if "def " in fence[2]:
            return {"Understand": text[: fence.start()], "Analyze": "", "Functions": fence[2]}
    return None
