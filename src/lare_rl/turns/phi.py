"""A phi over turns: events of a turn that a language model, or a person, has named by a program.

The program is read as data by the interpreter of `lare_rl.phi` (`phi/turn_program.py`), and never executed. It is checked on turns before
it is used: it must read all of them, always give the same names, and at least one of its events must differ among them.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.turn_program import TURN_FUNCTION_NAME, TurnProgram, read_turn_program
from lare_rl.turns.messages import Turn
from lare_rl.util.safe_io import read_json, read_text

__all__ = ["TurnPhi", "find_problems", "load_turn_phi", "read_turn_phi"]


@dataclass(frozen=True)
class TurnPhi:
    """A function from a turn to events. The events of all calls of a turn are added up."""

    program: TurnProgram

    @property
    def source(self) -> str:
        return self.program.source

    @property
    def digest(self) -> str:
        """The SHA-256 of the source."""
        return hashlib.sha256(self.source.encode()).hexdigest()

    def __call__(self, turn: Turn) -> dict[str, float]:
        """Return the events of a turn.

        Raises:
            LareError: the program fails on this turn.
        """
        try:
            return self.read_turn(turn)
        except RefusedError as refusal:
            raise LareError(f"the phi over turns failed on a turn: {refusal}") from None

    def read_turn(self, turn: Turn) -> dict[str, float]:
        """Return the events of a turn. Raises `RefusedError` with a message for the program's author."""
        if not turn.calls:
            return self.program.events("", {}, turn.reply, turn.text)
        total: dict[str, float] = {}
        for call in turn.calls:
            events = self.program.events(call.tool, _read_arguments(call.arguments), call.result, turn.text)
            total = {name: total.get(name, 0.0) + value for name, value in events.items()}
        return total


def _read_arguments(text: str) -> dict[str, object]:
    """Return the arguments of a call as a dictionary. A text that is not a JSON object is its entry `text`."""
    try:
        value = read_json(text, strict=False)
    except ValueError:
        value = None
    return value if isinstance(value, dict) else {"text": text}


def read_turn_phi(source: str) -> TurnPhi:
    """Read a program. Raises `LareError` if it is not Python, or defines no `turn_events`."""
    try:
        return TurnPhi(read_turn_program(source))
    except RefusedError as refusal:
        raise LareError(f"this is no phi over turns: {refusal}") from None


def load_turn_phi(path: str | Path) -> TurnPhi:
    """Read the phi over turns in a Python file.

    Raises:
        LareError: the file cannot be read, or it is no such program.
    """
    path = Path(path)
    source = read_text(path)
    if f"def {TURN_FUNCTION_NAME}" not in source:
        raise LareError(f"{path} has no function {TURN_FUNCTION_NAME}(tool, arguments, result, text)")
    try:
        return read_turn_phi(source)
    except LareError as error:
        raise LareError(f"{path}: {error}") from None


def find_problems(source: str, turns: Sequence[Turn]) -> str:
    """Return what is wrong with a program, for its author; an empty text if it passes on these turns."""
    try:
        phi = TurnPhi(read_turn_program(source))
        rows = [phi.read_turn(turn) for turn in turns]
    except RefusedError as refusal:
        return str(refusal)
    names = [tuple(row) for row in rows]
    for number, other in enumerate(names):
        if set(other) != set(names[0]):
            difference = sorted(set(other) ^ set(names[0]))
            return (
                f"E-NAMES turn {number + 1}: the events are not those of turn 1 ({', '.join(difference)[:200]}): return all "
                "events for every call, with the value False or 0 if they did not happen"
            )
    if all(row == rows[0] for row in rows):
        return "E-CONSTANT all events have the same values in all turns: name events that happen in some turns only"
    return ""
