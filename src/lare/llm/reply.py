"""What a reply must look like, and reading it."""

import json

from pydantic import ConfigDict, Field

from lare.errors import Checked, LareError


class MalformedReply(LareError):
    """A reply that cannot be read. The message goes back to the model."""


class Reply(Checked):
    """The JSON object that a request asks for."""

    model_config = ConfigDict(extra="ignore")

    understand: str = Field(alias="Understand")
    analyze: str = Field(alias="Analyze")
    functions: str = Field(alias="Functions", min_length=1)
    """Source of `evaluation_func(observation, action)`."""


def parse(text: str) -> Reply:
    """Raises `MalformedReply`, with what was wrong."""
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MalformedReply(f"the reply is not one JSON object: {error}") from error
    if not isinstance(values, dict):
        raise MalformedReply(f"the reply is JSON, but not an object: {text.strip()[:40]!r}")
    try:
        return Reply(**values)
    except LareError as error:
        raise MalformedReply(f"the reply's JSON object is not as asked for: {error}") from error
