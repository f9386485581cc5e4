"""A phi over turns: a program, by a language model or a person, that names the events of a turn.

The program is read as data by the interpreter of `lare_rl.phi` (`phi/turn_program.py`), and never executed. `design_turn_phi` checks it
on turns (`find_problems`): it must read all of them, always give the same names, and at least one of its events must differ among them.
A program from a file is only parsed.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.turn_program import NO_FUNCTION, TURN_FUNCTION_NAME, parse_turn_program, read_events
from lare_rl.turns.messages import Turn
from lare_rl.util.safe_io import read_json, read_text

__all__ = ["TurnPhi", "find_problems", "load_turn_phi", "read_turn_phi"]


@dataclass(frozen=True)
class TurnPhi:
    """A function from a turn to events. The events of all calls of a turn are added up."""

    source: str
    tree: ast.Module = field(repr=False, compare=False)
    """The parsed source."""
    model: str = ""
    """The name of the language model that wrote it, if it was designed."""

    def __call__(self, turn: Turn) -> dict[str, float]:
        """Return the events of a turn.

        Raises:
            LareError: the program fails on this turn. The message is for the program's author.
        """
        calls = [(call.tool, _read_arguments(call.arguments), call.result) for call in turn.calls]
        try:
            rows = [read_events(self.tree, *call, turn.text) for call in calls or [("", {}, turn.reply)]]
        except RefusedError as refusal:
            raise LareError(str(refusal)) from None
        _check_names(rows, "call")
        return {name: sum(row[name] for row in rows) for name in rows[0]}


def _read_arguments(text: str) -> dict[str, object]:
    """Return the arguments of a call as a dictionary. Arguments that are not a JSON object are returned as `{'text': arguments}`."""
    try:
        value = read_json(text, strict=False)
    except ValueError:
        value = None
    return value if isinstance(value, dict) else {"text": text}


def _check_names(rows: Sequence[Mapping[str, float]], unit: str) -> None:
    """Raise `LareError` if a call or a turn (the `unit` of the rows) has other events than the first one."""
    for number, row in enumerate(rows, start=1):
        if difference := sorted(row.keys() ^ rows[0].keys()):
            raise LareError(
                f"E-NAMES {unit} {number}: the events are not those of {unit} 1 ({', '.join(difference)[:200]}): return all events for "
                "every call, with the value False or 0 if they did not happen"
            )


def read_turn_phi(source: str) -> TurnPhi:
    """Read a program. Raises `LareError` if it is not Python, or defines no `turn_events`."""
    try:
        tree = parse_turn_program(source)
    except RefusedError as refusal:
        raise LareError(str(refusal)) from None
    functions = (node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    if TURN_FUNCTION_NAME not in functions:
        raise LareError(f"E-FORM {NO_FUNCTION}")
    return TurnPhi(source, tree)


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
        raise LareError(f"{path}: not a valid turn function: {error}") from None


def find_problems(phi: TurnPhi, turns: Sequence[Turn]) -> str:
    """Return a message to the author of a program that does not pass on these turns, or an empty text."""
    try:
        rows = [phi(turn) for turn in turns]
        _check_names(rows, "turn")
    except LareError as error:
        return str(error)
    if all(row == rows[0] for row in rows):
        return "E-CONSTANT all events have the same values in all turns: name events that happen in some turns only"
    return ""
