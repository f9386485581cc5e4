"""A phi over turns: a program, by a language model or a person, that names the events of a turn.

The program is read as data by the interpreter of `lare_rl.phi` (`phi/turn_program.py`), and never executed. `design_turn_phi` checks it
on turns (`find_problems`): it must read all of them, always give the same names, and at least one of its events must differ among them.
A program from a file is only parsed.
"""

import ast
from collections.abc import Mapping, Sequence
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

    def __call__(self, turn: Turn) -> dict[str, float]:
        """Return the events of a turn.

        Raises:
            LareError: the program fails on this turn.
        """
        try:
            return self.evaluate(turn)
        except RefusedError as refusal:
            raise LareError(f"the phi over turns failed: {refusal}") from None

    def evaluate(self, turn: Turn) -> dict[str, float]:
        """Return the events of a turn. Raises `RefusedError` with a message for the program's author."""
        if not turn.calls:
            return self.program.events("", {}, turn.reply, turn.text)
        rows = [
            self.program.events(call.tool, _read_arguments(call.arguments), call.result, turn.text)
            for call in turn.calls
        ]
        for number, row in enumerate(rows, start=1):
            _check_names(row, rows[0], f"call {number}", "call 1")
        return {name: sum(row[name] for row in rows) for name in rows[0]}


def _read_arguments(text: str) -> dict[str, object]:
    """Return the arguments of a call as a dictionary. Arguments that are not a JSON object are returned as `{'text': arguments}`."""
    try:
        value = read_json(text, strict=False)
    except ValueError:
        value = None
    return value if isinstance(value, dict) else {"text": text}


def _check_names(row: Mapping[str, float], first: Mapping[str, float], where: str, where_first: str) -> None:
    """Raise `RefusedError` if a call or a turn has other events than the first one."""
    if difference := sorted(row.keys() ^ first.keys()):
        message = (
            f"E-NAMES {where}: the events are not those of {where_first} ({', '.join(difference)[:200]}): return all events for "
            "every call, with the value False or 0 if they did not happen"
        )
        raise RefusedError("E-NAMES", message)


def read_turn_phi(source: str) -> TurnPhi:
    """Read a program. Raises `LareError` if it is not Python, or defines no `turn_events`."""
    try:
        program = read_turn_program(source)
    except RefusedError as refusal:
        raise LareError(f"not a valid turn function: {refusal}") from None
    functions = (node.name for node in ast.walk(program.tree) if isinstance(node, ast.FunctionDef))
    if TURN_FUNCTION_NAME not in functions:
        raise LareError(
            f"not a valid turn function: there is no function {TURN_FUNCTION_NAME}(tool, arguments, result, text)"
        )
    return TurnPhi(program)


def load_turn_phi(path: str | Path) -> TurnPhi:
    """Read the phi over turns in a Python file.

    Raises:
        LareError: the file cannot be read, is not Python, or defines no `turn_events`.
    """
    path = Path(path)
    source = read_text(path)
    try:
        return read_turn_phi(source)
    except LareError as error:
        raise LareError(f"{path}: {error}") from None


def find_problems(source: str, turns: Sequence[Turn]) -> str:
    """Return a message to the author of a program that does not pass on these turns, or an empty text."""
    try:
        phi = TurnPhi(read_turn_program(source))
        rows = [phi.evaluate(turn) for turn in turns]
        for number, row in enumerate(rows, start=1):
            _check_names(row, rows[0], f"turn {number}", "turn 1")
    except RefusedError as refusal:
        return str(refusal)
    if all(row == rows[0] for row in rows):
        return "E-CONSTANT all events have the same values in all turns: name events that happen in some turns only"
    return ""
