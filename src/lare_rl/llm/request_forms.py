"""The forms of a request, strictest first; after a refusal the next one is tried.

    responses   OpenAI's Responses API, with a JSON schema
    chat        chat completions: with a JSON schema, with a JSON object, or with the structure only in words

A `LiveModel` keeps the form that its server has answered.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

from lare_rl.llm.prompts import Message
from lare_rl.llm.reply import REPLY_KEYS
from lare_rl.util.safe_io import read_json

__all__ = ["MIN_REPLY_TOKENS", "Answer", "FailedResponseError", "RequestForms"]

MAX_REPLY_TOKENS, MIN_REPLY_TOKENS = 16_384, 1024
"""The limit on a reply's tokens. It is halved while the model allows less, down to the second number."""

_SCHEMA = {
    "name": "evaluation_function",
    "strict": True,
    "schema": {
        "type": "object",
        "properties": {key: {"type": "string"} for key in REPLY_KEYS},
        "required": REPLY_KEYS,
        "additionalProperties": False,
    },
}


class _RequestForm(NamedTuple):
    api: Literal["responses", "chat"]
    options: dict[str, Any]
    """Options that request a structure."""


_REQUEST_FORMS = (
    _RequestForm("responses", {"text": {"format": {"type": "json_schema", **_SCHEMA}}}),
    _RequestForm("chat", {"response_format": {"type": "json_schema", "json_schema": _SCHEMA}}),
    _RequestForm("chat", {"response_format": {"type": "json_object"}}),
    _RequestForm("chat", {}),
)
_CHAT_LIMITS = ("max_completion_tokens", "max_tokens")
"""The option that limits the tokens of a chat completion: its name for newer servers, and for older ones."""

_REFUSED_STATUSES = (400, 422)
_MISSING_API_STATUSES = (403, 404, 405, 500, 501)
"""What servers without the Responses API, or with a part of it, answer to such a request."""


class FailedResponseError(Exception):
    """An answer says that the model failed."""


class Answer(NamedTuple):
    """The content of an answer."""

    text: str
    usage: Any
    """The tokens that the server reports, under the names of chat completions. It may be anything."""
    is_cut_off: bool
    """Whether the limit on tokens ended the text."""


@dataclass(frozen=True)
class RequestForms:
    """How a server is asked: the forms that it may support, the present one first, and the options that it accepts."""

    forms: tuple[_RequestForm, ...] = _REQUEST_FORMS
    chat_limits: tuple[str, ...] = _CHAT_LIMITS
    reply_tokens: int = MAX_REPLY_TOKENS
    takes_temperature: bool = True
    is_verified: bool = False
    """Whether the server has answered a request in the first of these forms."""

    @property
    def api(self) -> str:
        return self.forms[0].api

    @property
    def may_lack_responses(self) -> bool:
        """Whether the server is asked through the Responses API, and has not answered such a request yet."""
        return self.api == "responses" and not self.is_verified

    def request(
        self, name: str, messages: Sequence[Message], max_tokens: int, temperature: float | None
    ) -> dict[str, Any]:
        """Return the arguments of a request."""
        options = {"model": name, **self.forms[0].options}
        if temperature is not None and self.takes_temperature:
            options["temperature"] = temperature
        if self.api == "responses":
            # OpenAI stores responses by default, and no chat completions.
            return {"input": list(messages), "max_output_tokens": max_tokens, "store": False, **options}
        return {"messages": list(messages), self.chat_limits[0]: max_tokens, **options}

    def without_responses(self) -> "RequestForms":
        """Return the forms of chat completions."""
        return replace(self, forms=tuple(form for form in self.forms if form.api == "chat"), is_verified=False)

    def after_http_error(self, status: int, body: str, max_tokens: int, has_temperature: bool) -> "RequestForms | None":
        """Return the forms after a refused request, or None if nothing is left to change.

        Args:
            status: the HTTP status.
            body: the body of the answer.
            max_tokens: the limit of the request.
            has_temperature: whether the user has set a temperature.
        """
        if status in _REFUSED_STATUSES:
            return self._ask_for_less(_without_echo(body).lower(), max_tokens, has_temperature)
        is_missing = self.may_lack_responses and status in _MISSING_API_STATUSES
        return self.without_responses() if is_missing else None

    def _ask_for_less(self, reason: str, max_tokens: int, has_temperature: bool) -> "RequestForms | None":
        """Ask for fewer tokens or without an option, if the refusal names it.

        If not, ask in the next form, unless this form has been answered before. None if nothing is left to change.
        """
        is_too_long = "token" in reason and re.search("large|at most|maximum|context|exceed", reason)
        if is_too_long and self.reply_tokens > MIN_REPLY_TOKENS:
            return replace(self, reply_tokens=max(MIN_REPLY_TOKENS, min(self.reply_tokens, max_tokens) // 2))
        older_limit = replace(self, chat_limits=self.chat_limits[1:]) if len(self.chat_limits) > 1 else None
        if older_limit and self.api == "chat" and "max_completion_tokens" in reason:
            return older_limit
        if "temperature" in reason and has_temperature and self.takes_temperature:
            return replace(self, takes_temperature=False)
        if self.is_verified:  # the server has answered this form before, so it refuses the text
            return None
        if len(self.forms) > 1:
            return replace(self, forms=self.forms[1:])
        return older_limit

    def read_answer(self, body: bytes) -> Answer:
        """Read the body of an answer.

        Raises:
            FailedResponseError: the model failed.
            ValueError, TypeError, KeyError, IndexError, AttributeError: the body is no answer of this API.
        """
        answer = read_json(body)
        return _read_response(answer) if self.api == "responses" else _read_completion(answer)


def _without_echo(body: str) -> str:
    """Return the body of a refusal without the request, which some servers repeat in it under the key `input`."""

    def remove(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: remove(item) for key, item in value.items() if key != "input"}
        return [remove(item) for item in value] if isinstance(value, list) else value

    try:
        return str(remove(read_json(body)))
    except ValueError:
        return body


def _read_completion(answer: Any) -> Answer:
    choice = answer["choices"][0]
    message = choice["message"]
    text = message.get("content") or message.get("refusal") or ""
    if not isinstance(text, str):
        raise TypeError("the content is not a text")
    return Answer(text, answer.get("usage"), choice.get("finish_reason") == "length")


def _read_response(answer: Any) -> Answer:
    if answer.get("status") == "failed":
        error = answer.get("error")
        reason = error.get("message") if isinstance(error, dict) else error
        raise FailedResponseError(reason or "no reason was named")
    messages = [item for item in answer["output"] if item["type"] == "message"]
    contents = [content for message in messages for content in message["content"]]
    text = "".join(content.get("text") or content.get("refusal") or "" for content in contents)
    is_cut_off = (answer.get("incomplete_details") or {}).get("reason") == "max_output_tokens"
    usage = answer.get("usage")
    if isinstance(usage, dict):
        usage = {"prompt_tokens": usage.get("input_tokens"), "completion_tokens": usage.get("output_tokens")}
    return Answer(text, usage, is_cut_off)
