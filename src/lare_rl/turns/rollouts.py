"""Rollouts of agents that talk: how they are read and checked.

A rollout is a mapping:

    {"messages": [...],             # in the form of OpenAI's chat completions
     "turns": [{"tests pass": 1}],  # optional numbers of each turn, from the environment; without messages, the turns themselves
     "outcome": 1.0,
     "group": "task-17",            # optional: rollouts of the same task
     "truncated": False}            # optional: whether it was cut off, so that the agent did not stop by itself

Other keys are ignored. A turn is an assistant's message with the messages that answer it, up to the next assistant's message.
Where names are equal, a number of `turns` replaces that of a phi, and both replace a feature of the messages.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lare_rl.errors import LareError, short_repr
from lare_rl.turns.messages import Turn, check_list, message_features, split_turns
from lare_rl.util.sanitize import NAME_RULE, is_name, one_line

__all__ = ["MAX_NUMBER", "Phi", "Rollout", "read_rollout", "read_rollouts"]

MAX_NUMBER = 1e9
"""The largest number of a turn, and the largest outcome. Sums of squares of larger numbers lose their digits."""
MIN_NUMBER = 1e-9
"""Smaller numbers are read as 0: their squares would be too small for a fit."""
MAX_TURNS = 10_000

Row = dict[str, float]
"""The numbers of a turn, by their names."""
Phi = Callable[[Turn], Mapping[str, float]]
"""A function that names events of a turn, and gives a number to each of them."""


@dataclass(frozen=True)
class Rollout:
    """A checked rollout."""

    turns: tuple[Mapping[str, float], ...]
    """The features of each turn."""
    outcome: float
    group: str
    """Empty without a group. A whole number becomes a text, so 1 and "1" are one group."""
    truncated: bool = False


def read_rollouts(rollouts: Any, phi: Phi | None = None) -> list[Rollout]:
    """Check rollouts and return them.

    Raises:
        LareError: a rollout is malformed, or `phi` fails. The message names the rollout by its index, from 0.
    """
    if isinstance(rollouts, Mapping | str | bytes) or not isinstance(rollouts, Iterable):
        raise LareError(f"rollouts must be a list of mappings, and not {short_repr(rollouts)}")
    return [read_rollout(rollout, f"rollout {number}", phi) for number, rollout in enumerate(rollouts)]


def read_rollout(rollout: Any, where: str, phi: Phi | None = None) -> Rollout:
    """Check one rollout and return it. `where` names it in messages.

    Raises:
        LareError: the rollout is malformed, or `phi` fails.
    """
    if not isinstance(rollout, Mapping):
        raise LareError(f"{where} must be a mapping with outcome and messages or turns, and is {short_repr(rollout)}")
    outcome = _read_number(rollout.get("outcome"), f"{where}: outcome")
    group = "" if rollout.get("group") is None else rollout["group"]
    if not isinstance(group, str | int | np.integer) or isinstance(group, bool):
        raise LareError(f"{where}: group must be a text or a whole number, and is {short_repr(group)}")
    truncated = False if rollout.get("truncated") is None else rollout["truncated"]
    if not isinstance(truncated, bool | np.bool_):
        raise LareError(f"{where}: truncated must be true or false, and is {short_repr(truncated)}")
    features = _read_features(rollout.get("messages"), rollout.get("turns"), where, phi)
    return Rollout(tuple(features), outcome, str(group), bool(truncated))


def _read_features(messages: Any, turn_numbers: Any, where: str, phi: Phi | None) -> list[Row]:
    """Return the features of each turn: those of the messages, of a phi, and of `turns`."""
    rows = None
    if turn_numbers is not None:
        check_list(turn_numbers, "turns", MAX_TURNS, where)
        rows = [_read_row(row, f"turns[{t}]", where) for t, row in enumerate(turn_numbers)]
    if messages is None:
        if rows is None:
            raise LareError(f"{where} has neither messages nor turns")
        if phi is not None:
            raise LareError(f"{where} has no messages, which a phi needs")
        if not rows:
            raise LareError(f"{where} has no turn")
        return rows
    turns = split_turns(messages, where)
    if not turns:
        raise LareError(f"{where} has no message with the role assistant")
    if len(turns) > MAX_TURNS:
        raise LareError(f"{where} has {len(turns)} turns, and may have {MAX_TURNS}")
    if rows is None:
        rows = [{}] * len(turns)
    if len(rows) != len(turns):
        raise LareError(
            f"{where} has {len(turns)} messages of the assistant, but turns has {len(rows)} of them: give one entry for each "
            "message of the assistant"
        )
    events = [{}] * len(turns) if phi is None else _evaluate(phi, turns, where)
    return [old | event | new for old, event, new in zip(message_features(turns), events, rows, strict=True)]


def _evaluate(phi: Phi, turns: Sequence[Turn], where: str) -> list[Row]:
    """Return the events of each turn. An error names the turn."""
    rows = []
    for t, turn in enumerate(turns):
        try:
            events = phi(turn)
        except LareError as error:
            raise LareError(f"{where}, turn {t}: phi failed: {error}") from error
        except Exception as error:  # phi is the user's function
            raise LareError(f"{where}, turn {t}: phi failed: {type(error).__name__}: {one_line(error)}") from error
        rows.append(_read_row(events, f"the result of phi for turn {t}", where))
    return rows


def _read_row(row: Any, what: str, where: str) -> Row:
    """Check the numbers of a turn and return them. `what` names them in messages."""
    if not isinstance(row, Mapping):
        raise LareError(f"{where}: {what} must map names to numbers, and is {short_repr(row)}")
    numbers = {}
    for name, value in row.items():
        if not is_name(name):
            raise LareError(f"{where}: {what} has the name {short_repr(name)}, which must be {NAME_RULE}")
        numbers[name] = _read_number(value, f"{where}: {name!r} in {what}")
    return numbers


def _read_number(value: Any, where: str) -> float:
    try:
        number = float(value) if not isinstance(value, str | bytes) else math.nan
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last one from a tensor of several numbers
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        raise LareError(
            f"{where} must be a number between -{MAX_NUMBER:g} and {MAX_NUMBER:g}, and is {short_repr(value)}"
        )
    return number if abs(number) >= MIN_NUMBER else 0.0
