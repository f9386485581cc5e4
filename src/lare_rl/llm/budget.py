"""The budget of a design: requests, tokens and time, checked before each request so that it is never exceeded."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lare_rl.errors import LareError
from lare_rl.llm.prompts import Message

MOST_TOKENS = 1 << 40
"""A server that reports more tokens is wrong."""
TIMEOUT, SHARE = 120.0, 1 / 8
"""The longest time for one reply: so many seconds, or this part of the time for all replies if that is longer."""


class BudgetSpent(LareError):
    """The next request might exceed the budget."""


@dataclass
class Budget:
    """What a design may cost, and what it has cost so far."""

    requests: int = 60
    tokens: int = 400_000
    seconds: float = 900.0
    """Waiting for the model, the pauses between two tries included."""
    requests_made: int = 0
    tokens_in: int = 0
    tokens_out: int = 0
    seconds_waited: float = 0.0
    estimated: bool = False
    """Whether a server did not report its tokens, so that bytes were counted instead."""

    def allow(self, messages: Sequence[Message], least: int = 1) -> int:
        """How many tokens the reply to a request may have, `least` or more. Each byte of the request counts as a token.

        Raises:
            BudgetSpent: no request is left, or not enough tokens.
        """
        if self.requests_made >= self.requests:
            raise BudgetSpent(f"the budget of {self.requests} requests is spent")
        self.wait(0.0)
        left = self.tokens - self.tokens_in - self.tokens_out - most_tokens(messages)
        if left < least:
            used = self.tokens_in + self.tokens_out
            raise BudgetSpent(f"the next request might exceed the budget of {self.tokens:,} tokens ({used:,} are used)")
        return left

    @property
    def timeout(self) -> float:
        """The longest time for one reply, in seconds."""
        return max(TIMEOUT, SHARE * self.seconds)

    @property
    def seconds_left(self) -> float:
        return max(0.0, self.seconds - self.seconds_waited)

    def wait(self, seconds: float) -> None:
        """Count a wait before it begins. Raises `BudgetSpent` if no time would be left after it."""
        if seconds >= self.seconds_left:
            spent = f"{self.seconds_waited:.0f} s are used" + (
                f", and {seconds:.0f} s are to be waited" if seconds else ""
            )
            raise BudgetSpent(f"the {minutes(self.seconds)} of waiting for the model are over ({spent})")
        self.seconds_waited += seconds

    @contextlib.contextmanager
    def clock(self) -> Iterator[None]:
        """Count the time that something takes."""
        start = time.monotonic()
        try:
            yield
        finally:
            self.seconds_waited += time.monotonic() - start

    def patience(self) -> str:
        """How long the next reply is waited for, in words."""
        return f"{min(self.timeout, self.seconds_left):.0f} s at most ({minutes(self.seconds_left)} are left for all)"

    def count(self, usage: Any, messages: Sequence[Message], reply: str) -> None:
        """Add the tokens of a reply, by the server's own count if it gives one."""
        try:
            tokens_in, tokens_out = int(usage["prompt_tokens"]), int(usage["completion_tokens"])
            if not 0 <= min(tokens_in, tokens_out) <= max(tokens_in, tokens_out) <= MOST_TOKENS:
                raise ValueError("no number of tokens")
        except (TypeError, KeyError, ValueError, OverflowError):
            tokens_in, tokens_out = most_tokens(messages), len(reply.encode(errors="replace"))
            self.estimated = True
        self.tokens_in += tokens_in
        self.tokens_out += tokens_out

    def summary(self, prices: tuple[float, float] | None = None) -> str:
        """What was used, in a line; `prices` are those of a million tokens in and out."""
        counted = " (counted as bytes: the server gave no numbers)" if self.estimated else ""
        text = f"{self.requests_made} requests, {self.tokens_in:,} tokens in, {self.tokens_out:,} out{counted}"
        if prices is not None:
            text += f", {(self.tokens_in * prices[0] + self.tokens_out * prices[1]) / 1e6:.4f} by the given prices"
        return text


def minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} minutes"


def most_tokens(messages: Sequence[Message]) -> int:
    """The most tokens that a request can have: one for each byte, and a few around each message."""
    return sum(len(message["content"].encode(errors="replace")) + 16 for message in messages)
