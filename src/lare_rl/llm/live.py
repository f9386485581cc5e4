"""A live language model behind an OpenAI-compatible endpoint: OpenAI, vLLM, Ollama, llama.cpp, gateways.

limits       of time and size: see `http_limits`; of requests, tokens and waiting: see `budget`
redirects    to another server are refused, because it would receive the request
retries      408, 409, 429, 5xx and broken connections, with back-off or after Retry-After, at most 60 s
requests     in the strictest form (API, and how the reply is structured) that the server supports: see `request_forms`
replies      are parsed by `reply`, whatever the form of the request
the key      see `key`
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from lare_rl.errors import LareError, abbreviate, install_command
from lare_rl.llm.budget import Budget, BudgetExceededError
from lare_rl.llm.http_limits import (
    MAX_BODY_BYTES,
    BodyTooLargeError,
    RedirectError,
    StatusError,
    check_response,
    read_body,
    run_in_time,
)
from lare_rl.llm.key import KEY_VARIABLE, api_key, redact_key
from lare_rl.llm.prompts import Message
from lare_rl.llm.request_forms import MIN_REPLY_TOKENS, FailedResponseError, RequestForms
from lare_rl.util.safe_io import read_json
from lare_rl.util.sanitize import one_line, replace_surrogates
from lare_rl.util.variables import read_variable

__all__ = ["LiveModel", "ModelError"]

_MAX_ATTEMPTS = 6
_MAX_PAUSE_S = 60.0
"""The longest pause before another attempt, even if the server asks for a longer one."""
_OPENAI_URL = "https://api.openai.com/v1"
_MAX_EXCERPT, _MAX_MESSAGE = 200, 500
"""Characters of an answer that a message quotes, and of the message."""

_RETRIED_STATUSES = {408, 409, 429}

# Errors by the beginnings of their names: the HTTP library (httpx or its successor) depends on the version of OpenAI's client.
_PERMANENT_ERRORS = ("UnsupportedProtocol", "InvalidURL", "LocalProtocolError")
_NOT_SENT_ERRORS = ("ConnectError", "ConnectTimeout", *_PERMANENT_ERRORS)


class ModelError(LareError):
    """The model cannot be asked, or gave no answer that can be read."""


class _Failure(NamedTuple):
    """The reason why a request has no reply, and what to do next."""

    message: str
    retry: bool
    """Whether a further attempt may succeed."""
    retry_after_s: float | None = None
    """The pause that the server asks for before the next attempt."""
    request_changed: bool = False
    """Whether the next request has another form. It is sent at once and does not count as an attempt."""
    timed_out: bool = False
    """Whether the reply took too long. The next attempt has twice the time."""


@dataclass
class LiveModel:
    """A model behind an OpenAI-compatible endpoint.

    The key is that of the environment variable OPENAI_API_KEY. A server of your own may need none. The default of `base_url` is
    OPENAI_BASE_URL, or else OpenAI's.

    Raises:
        ModelError: the name, the key or the address cannot be used, a key is needed and missing, or OpenAI's client is not installed.
    """

    name: str
    base_url: str | None = None
    temperature: float | None = None
    budget: Budget = field(default_factory=Budget)
    on_message: Callable[[str], None] = lambda _: None
    """Called with messages about waiting and retries."""
    sleep: Callable[[float], None] = time.sleep
    forms: RequestForms = field(default_factory=RequestForms)
    """The requests that the server may support. They become fewer when it refuses one."""

    def __post_init__(self) -> None:
        if not self.name.strip() or not self.name.isprintable():
            raise ModelError(f"{self.name!a} is not the name of a model")
        if not re.fullmatch(r"[!-~]*", api_key()):
            raise ModelError(f"the environment variable {KEY_VARIABLE} holds characters that no key can have")
        self.base_url = self.base_url or read_variable("OPENAI_BASE_URL")
        if not api_key() and not self.base_url:
            raise ModelError(
                f"to ask {self.name!r}, put a key into the environment variable {KEY_VARIABLE}, or name a server of "
                "your own with --base-url (http://localhost:11434/v1 for Ollama)"
            )
        # Without an address, the client would take even an empty OPENAI_BASE_URL.
        self.base_url = self.base_url or _OPENAI_URL
        try:
            self._client = self._connect()
        except ImportError:
            raise ModelError(f"a live model needs an extra: {install_command('llm')}") from None
        except Exception as error:  # the client raises errors of several kinds for a bad address
            url = _without_password(str(self.base_url))
            raise ModelError(f"the endpoint {url!r} cannot be used: {_safe_text(error)}") from None
        if not hasattr(self._client, "responses"):  # in versions of the client before 1.66
            self.forms = self.forms.without_responses()

    def _connect(self) -> Any:
        """Return a client that limits the time and the size of answers."""
        import openai

        return openai.OpenAI(
            api_key=api_key() or "none",
            base_url=self.base_url,
            max_retries=0,
            http_client=openai.DefaultHttpxClient(event_hooks={"response": [check_response]}),
            default_headers={"Accept-Encoding": "identity"},  # answers that are not compressed need no unpacking
        )

    def reply(self, messages: Sequence[Message], number: int) -> str:
        """Return a reply. `number` is not used: a live model gives a new reply each time.

        Raises:
            ModelError: no attempt gave a reply.
            BudgetExceededError: the budget does not allow another request, or its time is over.
        """
        self.on_message(f"{self.name}: waiting for a reply, {self.budget.timeout_text()}")
        attempts, timeout_factor, cause = 0, 1, ""
        while True:
            try:
                result = self._request(
                    messages, min(timeout_factor * self.budget.reply_timeout_s, self.budget.seconds_left)
                )
                if isinstance(result, str):
                    return redact_key(result)
                cause = f"; the last attempt failed: {result.message}"
                if result.request_changed:
                    continue
                attempts += 1
                timeout_factor *= 2 if result.timed_out else 1
                if not result.retry or attempts == _MAX_ATTEMPTS:
                    raise ModelError(f"{self.name} did not answer: {result.message}")
                pause_s = result.retry_after_s or 0.5 * 2 ** (attempts - 1)
                self.budget.add_pause(pause_s)
                self.on_message(f"{self.name}: {result.message}; trying again in {pause_s:.1f} s")
                self.sleep(pause_s)
            except BudgetExceededError as error:
                raise BudgetExceededError(f"{error}{cause}") from None

    def _request(self, messages: Sequence[Message], timeout_s: float) -> str | _Failure:
        max_tokens = min(self.forms.reply_tokens, self.budget.max_reply_tokens(messages, MIN_REPLY_TOKENS))
        request = self.forms.request(self.name, messages, max_tokens, self.temperature)
        api = self._client.responses if self.forms.api == "responses" else self._client.chat.completions

        def fetch() -> bytes:
            with api.with_streaming_response.create(**request, timeout=timeout_s) as response:
                return read_body(response)

        try:
            with self.budget.count_request():
                body = run_in_time(fetch, timeout_s)
        except Exception as error:  # the errors of the HTTP library depend on the client's version
            failure = self._failure(error.__cause__ or error, messages, max_tokens)
            if not failure.timed_out:
                return failure
            return failure._replace(
                message=f"no reply within {timeout_s:.0f} s; more --minutes allow more ({failure.message})"
            )
        return self._read_answer(body, messages, max_tokens)

    def _read_answer(self, body: bytes, messages: Sequence[Message], max_tokens: int) -> str | _Failure:
        """Return the text of an answer. A body that is no answer is a failure."""
        try:
            answer = self.forms.read_answer(body)
        except FailedResponseError as error:
            self.budget.count_reply(None, messages, len(body))
            return _Failure(_safe_text(f"the model failed: {error}"), retry=True)
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            self.budget.count_reply(None, messages, len(body))
            kind = "response" if self.forms.api == "responses" else "chat completion"
            reason = f"the answer is not a {kind} ({type(error).__name__}: {error})"
            is_missing = self.forms.may_lack_responses
            if is_missing:  # some servers answer any request for an unknown address
                self.forms = self.forms.without_responses()
            page = _excerpt(body.decode(errors="replace"))
            return _Failure(_safe_text(f"{reason}: {page}"), retry=True, request_changed=is_missing)
        self.forms = replace(self.forms, is_verified=True)
        text = replace_surrogates(answer.text)
        self.budget.count_reply(answer.usage, messages, len(body))  # of the whole body, which may hold hidden reasoning
        if answer.is_cut_off:
            self.on_message(f"{self.name}: a reply was cut off at the {max_tokens:,} tokens that it was allowed")
        return text

    def _failure(self, error: BaseException, messages: Sequence[Message], max_tokens: int) -> _Failure:
        """Describe the error of a request, and count the most that the request may have cost."""
        name = type(error).__name__
        if isinstance(error, StatusError):
            return self._http_error(error, max_tokens)
        if isinstance(error, RedirectError):
            return _Failure(_safe_text(error), retry=False)
        if isinstance(error, ValueError):  # half of a surrogate pair in a message, or a temperature that is not finite
            return _Failure(_safe_text(f"the request cannot be written as JSON: {error}"), retry=False)
        if isinstance(error, BodyTooLargeError):
            self.budget.count_reply(None, messages, MAX_BODY_BYTES)
            return _Failure(str(error), retry=False)
        if name.startswith(_NOT_SENT_ERRORS):
            message = f"{_without_password(str(self._client.base_url))} cannot be reached: {error}"
            return _Failure(_safe_text(message), retry=not name.startswith(_PERMANENT_ERRORS))
        if isinstance(error, TimeoutError):  # a thread may still read with the old client
            self._client.close()
            self._client = self._connect()
        self.budget.count_reply(None, messages, max_tokens)  # the server may have answered
        return _Failure(_safe_text(f"{name}: {error}"), retry=True, timed_out="Timeout" in name)

    def _http_error(self, error: StatusError, max_tokens: int) -> _Failure:
        """Handle an HTTP error: change the request, wait, or give up."""
        message = _safe_text(f"HTTP {error.status}: {_error_text(error.body)}")
        forms = self.forms.after_http_error(error.status, error.body, max_tokens, self.temperature is not None)
        if forms is not None:
            self.forms = forms
            return _Failure(message, retry=True, request_changed=True)
        may_recover = error.status in _RETRIED_STATUSES or error.status >= 500
        retry = may_recover and "insufficient_quota" not in error.body
        return _Failure(message, retry, retry_after_s=_retry_after_s(error.headers))


def _safe_text(text: object) -> str:
    """Return a message in one line, without the key and without control characters."""
    return redact_key(one_line(text))[:_MAX_MESSAGE]


def _without_password(url: str) -> str:
    """Return an address without the name and the password of its user."""
    return re.sub(r"(?s)^([^/:]*://)?.*@", r"\1", url)


def _excerpt(body: str) -> str:
    text = one_line(redact_key(body))  # before it is cut, because a cut could leave a part of the key
    return repr(abbreviate(text, _MAX_EXCERPT))


def _error_text(body: str) -> str:
    """Return the message of an error in OpenAI's form, or an excerpt of another body."""
    try:
        return str(read_json(body)["error"]["message"])
    except (ValueError, TypeError, KeyError, IndexError):
        return _excerpt(body)


def _retry_after_s(headers: Any) -> float | None:
    """Return the seconds of the header Retry-After. A date is ignored."""
    try:
        return min(_MAX_PAUSE_S, max(0.0, float(headers.get("retry-after"))))
    except (TypeError, ValueError):
        return None
