"""The form of a model's reply, and its parser."""

import json
import re
import textwrap
from typing import Any

from pydantic import ConfigDict, Field

from lare_rl.errors import CheckedModel, LareError
from lare_rl.llm.key import redact_key
from lare_rl.util.safe_io import check_depth, parse_integer, read_json

__all__ = ["REPLY_KEYS", "MalformedReplyError", "Reply", "parse_reply"]

_MAX_CHARACTERS = 200_000
_MAX_STARTS = 100
"""How many positions of a text are tried as the start of an object, at most."""


class MalformedReplyError(LareError):
    """A reply that cannot be read. The message goes back to the model."""


class Reply(CheckedModel):
    """The JSON object that a request asks for."""

    model_config = ConfigDict(extra="ignore")

    understand: str = Field(alias="Understand")
    analyze: str = Field(alias="Analyze")
    functions: str = Field(alias="Functions", min_length=1)
    """Source of `evaluation_func(observation, action)`, without fences and without the API key."""


REPLY_KEYS = [str(field.alias) for field in Reply.model_fields.values()]
_FUNCTIONS_KEY = REPLY_KEYS[-1]

# A reply that was cut off may lack the end of its last fence.
_FENCED_BLOCK = re.compile(r"```[^\n`]*+\n(?P<code>.*?)(?:```|\Z)", re.DOTALL)
# Some models write their reasoning first, which may contain drafts of the answer.
_REASONING_END = re.compile(r"</think(?:ing)?>")
_FUNCTION_START = re.compile(r"^\s*def \w+\(", re.MULTILINE)
_OBJECT_START = re.compile(r'\{\s*"')


def parse_reply(text: str) -> Reply:
    """Read a reply: one JSON object, bare, in a fence, or among other words; or else a fenced function.

    Raises `MalformedReplyError` if the text is none of these.
    """
    if not text.strip():
        raise MalformedReplyError("the reply is empty")
    if len(text) > _MAX_CHARACTERS:
        raise MalformedReplyError(f"the reply has {len(text)} characters; at most {_MAX_CHARACTERS} are read")
    _check_characters(text)
    try:
        values, problem = read_json(text, strict=False), f"is JSON, but not an object: {text.strip()[:40]!r}"
    except ValueError as error:
        reason = f": {error}" if "{" in text else ", and has no fenced function"
        values, problem = None, f"is not one JSON object{reason}"
    if not isinstance(values, dict):
        values = _find_object(text)
    if values is None:
        raise MalformedReplyError(f"the reply {problem}")
    try:
        reply = Reply(**values)
    except LareError as error:
        raise MalformedReplyError(f"the reply's JSON object does not have the requested form: {error}") from error
    fences = list(_FENCED_BLOCK.finditer(reply.functions))
    # A fence may also stand in the docstring of a function that has no fence.
    is_fenced = not _FUNCTION_START.search(_FENCED_BLOCK.sub("", reply.functions))
    is_fenced &= any(_FUNCTION_START.search(fence["code"]) for fence in fences)
    functions = _join_functions(fences) if is_fenced else reply.functions
    texts = {"understand": reply.understand, "analyze": reply.analyze, "functions": functions}
    for value in texts.values():
        _check_characters(value)
    return reply.model_copy(update={name: redact_key(value) for name, value in texts.items()})


def _check_characters(text: str) -> None:
    """Refuse a lone surrogate: JSON can express it, but no file can store it."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise MalformedReplyError(
            f"the reply holds {text[error.start]!a}, which is half a character (a surrogate)"
        ) from None


def _join_functions(fences: list[re.Match[str]]) -> str:
    """Return the code of fences with functions. If a function is defined twice, the last definition counts."""
    codes = [textwrap.dedent(fence["code"]) for fence in fences]
    return "\n\n".join([code for code in codes if "def " in code] or codes)  # others show what to import, or an example


def _find_object(text: str) -> dict[str, Any] | None:
    """Return the object that `_find_object_after` finds after the reasoning, or else in the whole text."""
    reasoning_end = max((match.end() for match in _REASONING_END.finditer(text)), default=0)
    values = _find_object_after(text, reasoning_end)
    return _find_object_after(text, 0) if values is None and reasoning_end else values


def _find_object_after(text: str, reasoning_end: int) -> dict[str, Any] | None:
    """Return the last object with all keys, or else with `Functions`, or else the fenced functions as such an object."""
    decoder = json.JSONDecoder(strict=False, parse_int=parse_integer)
    incomplete = None
    starts = [match.start() for match in _OBJECT_START.finditer(text)]
    for start in reversed(starts[-_MAX_STARTS:]):
        try:
            value, end = decoder.raw_decode(text, start)
            check_depth(value)
        except (ValueError, RecursionError):
            continue
        if end <= reasoning_end:
            continue
        if value.keys() >= set(REPLY_KEYS):
            return value
        if _FUNCTIONS_KEY in value:
            incomplete = incomplete or value
    fences = [fence for fence in _FENCED_BLOCK.finditer(text, reasoning_end) if "def " in fence["code"]]
    if incomplete is not None or not fences:
        return incomplete
    return dict(zip(REPLY_KEYS, (text[reasoning_end : fences[0].start()], "", _join_functions(fences)), strict=True))
