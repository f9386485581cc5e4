"""Constructor arguments that all tasks have."""

from collections.abc import Callable
from typing import Any, Literal

__all__ = ["Pay", "Policy", "Split", "check_option"]

Split = Literal["train", "test"]
"""Which episodes are played: those for training, or the held-out ones. No year, map or demand is in both."""

Pay = Literal["end", "proxy"]
"""The reward: the score at the last step and 0 before, or a dense proxy in each step."""

Policy = Callable[[Any], Any]
"""From an observation to an action."""


def check_option(name: str, value: str, options: tuple[str, ...]) -> str:
    """Return `value`. Raise `ValueError` if it is not among the options."""
    if value not in options:
        raise ValueError(f"{name} = {value!r}: it must be one of {', '.join(options)}")
    return value
