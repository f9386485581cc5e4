"""A live language model behind any OpenAI-compatible endpoint: OpenAI, vLLM, Ollama, llama.cpp, gateways.

    time-outs    see `budget`
    redirects    to another server are refused, because it would receive the request
    retries      408, 409, 429, 5xx and broken connections, with back-off or after the time that the server names
    structure    requested as a JSON schema; as a JSON object if the server has no schemas; else only in words
    budget       see `budget`
    the key      see `key`

`reply` parses every reply, however its structure was requested.
"""

import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from lare_rl.errors import LareError, pip_install
from lare_rl.llm.bounded import LARGEST_BODY, Elsewhere, TooMuch, bound, in_time, stay
from lare_rl.llm.budget import Budget, BudgetSpent
from lare_rl.llm.key import VARIABLE, key, without_key
from lare_rl.llm.prompts import Message
from lare_rl.util.safe_io import read_json
from lare_rl.util.sanitize import in_a_line

TRIES = 6
"""Tries of one request, the first included."""

LONGEST_WAIT = 60.0
"""Seconds between two tries, whatever the server asks for."""

REPLY_TOKENS, SHORTEST_REPLY = 16_384, 1024
"""The largest number of tokens of a reply. It is halved while the model allows less, down to the second number."""

LONGEST_EXCERPT = 200
"""The most characters that a message quotes of an answer that cannot be read."""

RETRIED = {408, 409, 429}

HOPELESS = ("UnsupportedProtocol", "InvalidURL", "LocalProtocolError", "Elsewhere")
NOT_SENT = ("Connect", *HOPELESS)
"""Beginnings of names of errors. HOPELESS: another try would fail too. NOT_SENT: the request did not reach the server."""

PLAIN = {"Accept-Encoding": "identity"}
"""Asks for answers that are not packed, which need no memory to be unpacked."""

SCHEMA = {
    "type": "object",
    "properties": {key: {"type": "string"} for key in ("Understand", "Analyze", "Functions")},
    "required": ["Understand", "Analyze", "Functions"],
    "additionalProperties": False,
}

LADDER: tuple[dict[str, Any] | None, ...] = (
    {"type": "json_schema", "json_schema": {"name": "evaluation_function", "strict": True, "schema": SCHEMA}},
    {"type": "json_object"},
    None,
)
"""Ways to ask for structure, the strictest first."""

LIMITS = ("max_completion_tokens", "max_tokens")
"""The name of the limit on a reply's tokens, for newer servers and for older ones."""


class ModelFailed(LareError):
    """The model could not be asked, or gave nothing that can be read as an answer."""


@dataclass
class LiveModel:
    """Asks an OpenAI-compatible endpoint.

    The key is that of the environment variable OPENAI_API_KEY; a server of your own may need none. The default of `base_url` is
    OPENAI_BASE_URL, or else OpenAI's.
    """

    name: str
    base_url: str | None = None
    temperature: float | None = None
    budget: Budget = field(default_factory=Budget)
    said: Callable[[str], None] = lambda _: None
    """Called with messages about waiting and retries."""
    sleep: Callable[[float], None] = time.sleep
    rung: int = 0
    limit_name: int = 0
    longest: int = REPLY_TOKENS

    def __post_init__(self) -> None:
        if not self.name.strip() or not self.name.isprintable():
            raise ModelFailed(f"{self.name!a} is not the name of a model")
        if not re.fullmatch(r"[!-~]*", key()):
            raise ModelFailed(f"the environment variable {VARIABLE} holds characters that no key can have")
        base_url = self.base_url or os.environ.get("OPENAI_BASE_URL")
        if not key() and base_url is None:
            raise ModelFailed(
                f"to ask {self.name!r}, put a key into the environment variable {VARIABLE}, or name a server of "
                "your own with --base-url (http://localhost:11434/v1 for Ollama)"
            )
        self.endpoint = base_url
        try:
            self.client = self.connect()
        except ImportError:
            raise ModelFailed(f"a live model needs an extra: {pip_install('llm')}") from None
        except Exception as error:
            raise ModelFailed(f"the endpoint {base_url!r} cannot be used: {scrubbed(error)}") from None

    def connect(self) -> Any:
        """A client that limits the time and the size of answers."""
        import openai

        limit = self.budget.timeout
        http = openai.DefaultHttpxClient(event_hooks={"response": [stay, partial(bound, limit=limit)]}, timeout=limit)
        return openai.OpenAI(
            api_key=key() or "none", base_url=self.endpoint, max_retries=0, http_client=http, default_headers=PLAIN
        )

    def reply(self, messages: Sequence[Message], sample: int) -> str:
        """One reply. `sample` is not used: a live model gives a new reply each time.

        Raises:
            ModelFailed: there was no reply, after all tries.
            BudgetSpent: the budget does not allow another request, or its time is over.
        """
        self.said(f"{self.name}: waiting for a reply, {self.budget.patience()}")
        failure, tries = Failure("nothing was tried", again=True), 0
        while failure.again and tries < TRIES:
            try:
                if failure.wait:
                    self.budget.wait(failure.wait)
                    self.said(f"{self.name}: {failure.said}; trying again in {failure.wait:.1f} s")
                    self.sleep(failure.wait)
                outcome = self.ask(messages)
            except BudgetSpent as error:
                why = f"; the last try failed: {failure.said}" if tries else ""
                raise BudgetSpent(f"{error}{why}") from None
            if isinstance(outcome, str):
                return without_key(outcome)
            tries += outcome.wait is not None
            failure = outcome
            if failure.wait == 0:
                failure = replace(failure, wait=0.5 * 2 ** (tries - 1))
        raise ModelFailed(f"{self.name} did not answer: {failure.said}")

    def ask(self, messages: Sequence[Message]) -> "str | Failure":
        """One request: the reply, or why there is none."""
        import openai

        allowed = min(self.longest, self.budget.allow(messages, SHORTEST_REPLY))
        options: dict[str, Any] = {LIMITS[self.limit_name]: allowed}
        if LADDER[self.rung] is not None:
            options["response_format"] = LADDER[self.rung]
        if self.temperature is not None:
            options["temperature"] = self.temperature
        self.budget.requests_made += 1
        create = self.client.chat.completions.with_streaming_response.create

        def fetch() -> bytes:
            with create(model=self.name, messages=list(messages), **options) as response:  # type: ignore[arg-type]
                return response.read()

        try:
            with self.budget.clock():
                body = in_time(fetch, min(self.budget.timeout, self.budget.seconds_left))
        except openai.APIStatusError as error:
            return self.refused(error)
        except openai.APIConnectionError as error:
            where, cause = re.sub(r"//[^/@]*@", "//", str(self.client.base_url)), error.__cause__ or error
            if not type(cause).__name__.startswith(NOT_SENT):
                self.count_all(messages, allowed)
            hopeless = type(cause).__name__.startswith(HOPELESS)
            return Failure(scrubbed(f"{where} cannot be reached: {cause}"), again=not hopeless)
        except (openai.OpenAIError, OSError) as error:
            if isinstance(error, TimeoutError):  # the thread that is still reading keeps the old client
                self.client.close()
                self.client = self.connect()
            self.count_all(messages, allowed)
            return Failure(scrubbed(f"{type(error).__name__}: {error}"), again=True)
        except TooMuch as error:
            self.budget.count(None, messages, "x" * LARGEST_BODY)
            return Failure(str(error), again=False)
        except Elsewhere as error:
            return Failure(scrubbed(error), again=False)
        except Exception as error:  # the transport's errors while a body is read depend on the client's version
            self.count_all(messages, allowed)
            return Failure(scrubbed(f"the answer broke off ({type(error).__name__}: {error})"), again=True)
        return self.read(body, messages, allowed)

    def count_all(self, messages: Sequence[Message], allowed: int) -> None:
        """Count an aborted request at the most that it may have cost, because the server may have answered it."""
        self.budget.count(None, messages, "x" * allowed)

    def read(self, body: bytes, messages: Sequence[Message], allowed: int) -> "str | Failure":
        """The text of a chat completion. If the answer is not a chat completion, the request is tried again."""
        try:
            answer = read_json(body)
            choice = answer["choices"][0]
            message = choice["message"]
            text = message.get("content") or message.get("refusal") or ""
            if not isinstance(text, str):
                raise TypeError("the content is not a text")
            text = text.encode(errors="replace").decode()  # replaces lone surrogates
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            self.budget.count(None, messages, body.decode(errors="replace"))
            what = f"the answer is not a chat completion ({type(error).__name__}: {error})"
            return Failure(scrubbed(f"{what}: {excerpt(body.decode(errors='replace'))}"), again=True)
        self.budget.count(answer.get("usage"), messages, text)
        if choice.get("finish_reason") == "length":
            self.said(f"{self.name}: a reply was cut off at the {allowed:,} tokens that it was allowed")
        return text

    def refused(self, error: Any) -> "Failure":
        """Handle an HTTP error: ask for less, wait, or give up."""
        status, body = error.status_code, getattr(error, "body", None)
        # The client's own message leaves out a body that is not JSON, such as the page of a proxy or a plain sentence.
        said = scrubbed(f"{error}: {excerpt(body)}" if isinstance(body, str) and body.strip() else error)
        if status in (400, 422) and self.step_down(said.lower()):
            return Failure(said, again=True, wait=None)
        again = (status in RETRIED or status >= 500) and "insufficient_quota" not in said
        wait = min(LONGEST_WAIT, seconds(error.response.headers.get("retry-after")))
        return Failure(f"HTTP {status}: {said}", again, wait)

    def step_down(self, said: str) -> bool:
        """Ask for less, of a server that supports or allows less. False if there is nothing less to ask for."""
        too_long = "token" in said and any(
            word in said for word in ("large", "at most", "maximum", "context", "exceed")
        )
        if too_long and self.longest > SHORTEST_REPLY:
            self.longest //= 2
        elif "max_completion_tokens" in said and self.limit_name == 0:
            self.limit_name = 1
        elif "temperature" in said and self.temperature is not None:
            self.temperature = None
        elif self.rung + 1 < len(LADDER):
            self.rung += 1
        elif self.limit_name == 0:
            self.limit_name = 1
        else:
            return False
        return True


@dataclass(frozen=True)
class Failure:
    """Why a request gave no reply, and whether it is worth another try."""

    said: str
    again: bool
    wait: float | None = 0.0
    """Seconds until the next try; 0 if the server has not named them, None if a different request is sent at once."""


def scrubbed(text: object) -> str:
    """A message in one line, without the key, and without control characters."""
    return without_key(in_a_line(text))[:500]


def excerpt(body: str) -> str:
    """The beginning of an answer that cannot be read."""
    text = in_a_line(body[:2000])
    return repr(text if len(text) <= LONGEST_EXCERPT else f"{text[:LONGEST_EXCERPT]}...")


def seconds(retry_after: str | None) -> float:
    """The header Retry-After in seconds; 0 if it is missing, or is a date."""
    try:
        return max(0.0, float(retry_after or 0))
    except ValueError:
        return 0.0
