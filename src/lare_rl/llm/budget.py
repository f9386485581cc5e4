"""The budget of a design: requests, tokens and time. No request is sent that might exceed it."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lare_rl.errors import LareError
from lare_rl.llm.prompts import Message
from lare_rl.util.findings import format_for_reader

__all__ = ["Budget", "BudgetExceededError", "max_request_tokens"]

_MAX_REPORTED_TOKENS = 1 << 40  # a server that reports more is wrong


class BudgetExceededError(LareError):
    """The next request might exceed the budget."""


@dataclass
class Budget:
    """The limits of a design, and what it has used so far."""

    requests: int = 60
    tokens: int = 400_000
    seconds: float = 900.0
    """The time to wait for the model. Pauses between two attempts count too."""
    requests_used: int = 0
    tokens_in: int = 0
    tokens_out: int = 0
    seconds_used: float = 0.0
    is_upper_bound: bool = False
    """Whether more tokens may be counted than were used, because a server did not report them."""

    def max_reply_tokens(self, messages: Sequence[Message], min_tokens: int) -> int:
        """Return how many tokens the reply to a request may have: those that are left, less the bytes of the request.

        Raises:
            BudgetExceededError: no request or time is left, or fewer than `min_tokens` tokens.
        """
        if self.requests_used >= self.requests:
            budget = format_for_reader(self.requests, "count request")
            raise BudgetExceededError(f"the budget of {budget} is spent")
        self._check_time()
        used = self.tokens_in + self.tokens_out
        remaining = self.tokens - used - max_request_tokens(messages)
        if remaining < min_tokens:
            raise BudgetExceededError(
                f"the next request might exceed the budget of {self.tokens:,} tokens ({used:,} are used)"
            )
        return remaining

    @property
    def reply_timeout_s(self) -> float:
        """The longest time for the first attempt at the next reply.

        It is the larger of 120 s and an eighth of `seconds`, but at most the time left.
        """
        return min(max(120.0, self.seconds / 8), self.seconds_left)

    @property
    def seconds_left(self) -> float:
        """The time that is left for all further replies."""
        return max(0.0, self.seconds - self.seconds_used)

    def add_pause(self, seconds: float) -> None:
        """Count a pause before it begins. Raises `BudgetExceededError` if no time would be left after it."""
        self._check_time(seconds)
        self.seconds_used += seconds

    def _check_time(self, pause_s: float = 0.0) -> None:
        if pause_s >= self.seconds_left:
            pause = f", and a pause of {pause_s:.0f} s comes next" if pause_s else ""
            used = f"{self.seconds_used:.1f} of {self.seconds:g} s are used"
            raise BudgetExceededError(f"no time is left to wait for the model ({used}{pause})")

    @contextlib.contextmanager
    def count_request(self) -> Iterator[None]:
        """Count a request, and the time of the block."""
        self.requests_used += 1
        start = time.monotonic()
        try:
            yield
        finally:
            self.seconds_used += time.monotonic() - start

    def timeout_text(self) -> str:
        """Return the longest time for the first attempt at the next reply, in words."""
        remaining = format_for_reader(self.seconds_left, "seconds")
        return f"{self.reply_timeout_s:.0f} s at most ({remaining} are left for the whole design)"

    def count_reply(self, usage: Any, messages: Sequence[Message], reply_bound: int) -> None:
        """Add the tokens of a request and its reply.

        Args:
            usage: the numbers that the server reports, or anything else. Without them, upper bounds are counted.
            reply_bound: an upper bound on the tokens of the reply.
        """
        try:
            tokens_in, tokens_out = int(usage["prompt_tokens"]), int(usage["completion_tokens"])
            if not (0 <= tokens_in <= _MAX_REPORTED_TOKENS and 0 <= tokens_out <= _MAX_REPORTED_TOKENS):
                raise ValueError("not a number of tokens")
        except (TypeError, KeyError, ValueError, OverflowError):
            tokens_in, tokens_out = max_request_tokens(messages), reply_bound
            self.is_upper_bound = True
        self.tokens_in += tokens_in
        self.tokens_out += tokens_out

    def summary(self, prices: tuple[float, float] | None = None) -> str:
        """Return what was used, in one line. `prices` are those of a million tokens in, and of a million tokens out."""
        bound = " (an upper bound, because the server did not give all numbers)" if self.is_upper_bound else ""
        requests = format_for_reader(self.requests_used, "count request")
        text = f"{requests}, {self.tokens_in:,} tokens in, {self.tokens_out:,} out{bound}"
        if prices is not None:
            text += f", {(self.tokens_in * prices[0] + self.tokens_out * prices[1]) / 1e6:.4f} by the given prices"
        return text


def max_request_tokens(messages: Sequence[Message]) -> int:
    """Return a generous estimate of the tokens of a request: the bytes of its messages, plus 16 for each message."""
    return sum(len(message["content"].encode(errors="replace")) + 16 for message in messages)
