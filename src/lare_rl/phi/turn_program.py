"""Reads a phi over turns: a program that looks at one call of a tool, and returns what happened as named numbers, the events.

    def turn_events(tool, arguments, result, text):
        return {"tests pass": tool == "test" and "passed" in result.lower()}

The language is that of `read.py`, with `find_numbers(text)`, which returns the numbers in a text. NumPy may be used, but events are
plain numbers. `tool`, `result` and `text` are texts, and `arguments` is a dictionary. The program starts from nothing for each call of a
tool, so it cannot remember earlier ones.
"""

import ast
import math
import re
from collections.abc import Mapping
from typing import Any

from lare_rl.errors import short_repr
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.interpreter import Interpreter
from lare_rl.phi.limits import MAX_FACTORS, MAX_INT_BITS, MAX_TEXT_LENGTH, RefusedError
from lare_rl.phi.read import located_refusal, parse
from lare_rl.phi.runtime import Meter
from lare_rl.phi.values import Bound, Function, describe
from lare_rl.util.sanitize import NAME_RULE, is_name

__all__ = ["NO_FUNCTION", "TURN_FUNCTION_NAME", "parse_turn_program", "read_events", "shorten"]

TURN_FUNCTION_NAME = "turn_events"
"""The name of the function that a program must define."""
NO_FUNCTION = f"there is no function {TURN_FUNCTION_NAME}(tool, arguments, result, text)"
MAX_STEPS = 150_000  # for one call; a method of a text takes a step for each of its characters
MAX_EVENT_VALUE = 1e6
MAX_ARGUMENTS = 100  # entries of the arguments, and of each list or dictionary within them
MAX_ARGUMENT_DEPTH = 4
MAX_KEY_LENGTH = 240
MAX_FOUND_NUMBERS = 1000
MAX_NUMBER = 1e300  # in texts and arguments; larger ones become this one
OMISSION = "\n... (the middle of a long text is left out) ...\n"
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d{1,300}(?:\.\d{1,300})?|\.\d{1,300})(?:[eE][-+]?\d{1,3})?(?!\d)")


def parse_turn_program(source: str) -> ast.Module:
    """Parse a program. Other errors appear when it reads turns.

    Raises:
        RefusedError: the text is not Python, too long or nested too deep, or has invisible characters.
    """
    try:
        return parse(source)
    except RefusedError as refusal:
        raise RefusedError(refusal.code, refusal.located(refusal.line or 1), refusal.line) from None


def read_events(tree: ast.Module, tool: str, arguments: Mapping[str, Any], result: str, text: str) -> dict[str, float]:
    """Return the events of one call: names and numbers.

    The program sees texts of more than `MAX_TEXT_LENGTH` characters without their middle, at most `MAX_ARGUMENTS` entries of a list
    or a dictionary, and "..." for what is nested deeper than `MAX_ARGUMENT_DEPTH`.

    Args:
        tree: the parsed program.
        tool: the name of the tool; empty if none was called.
        arguments: the arguments of the call.
        result: what the tool answered, or without a tool what the user did.
        text: what the assistant said.

    Raises:
        RefusedError: the program fails, costs too much, or returns something else. The message has a line for its author.
    """
    with building(builder := Builder()):
        interpreter = Interpreter(builder, MAX_STEPS)
        interpreter.module["find_numbers"] = Bound(lambda value: _find_numbers(interpreter.meter, value))
        inputs = [shorten(tool), _copy_argument(dict(arguments)), shorten(result), shorten(text)]
        try:
            interpreter.run(tree.body, interpreter.module)
            function = interpreter.module.get(TURN_FUNCTION_NAME)
            if not isinstance(function, Function):
                raise RefusedError("E-FORM", NO_FUNCTION)
            return _check_events(interpreter.call(function, inputs, {}))
        except Exception as error:  # no text may stop the process that reads it
            refusal = located_refusal(error, interpreter)
    raise refusal


def shorten(text: str, length: int = MAX_TEXT_LENGTH) -> str:
    """Return a text, without its middle if it is longer than a program may read."""
    if len(text) <= length:
        return text
    half = (length - len(OMISSION)) // 2
    return text[:half] + OMISSION + text[len(text) - half :]


def _copy_argument(value: Any, depth: int = 0) -> Any:
    """Return an argument of a tool as a value of a program: texts, numbers, lists and dictionaries of bounded size."""
    if isinstance(value, str):
        return shorten(value)
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int):
        return value if value.bit_length() <= MAX_INT_BITS else _bound(value)
    if isinstance(value, float):
        return _bound(value) if not math.isnan(value) else 0.0
    if depth == MAX_ARGUMENT_DEPTH:
        return "..."
    if isinstance(value, Mapping):
        entries = list(value.items())[:MAX_ARGUMENTS]
        return {shorten(str(key), MAX_KEY_LENGTH): _copy_argument(item, depth + 1) for key, item in entries}
    if isinstance(value, list | tuple):
        return [_copy_argument(item, depth + 1) for item in value[:MAX_ARGUMENTS]]
    return "..."


def _bound(number: float) -> float:
    return float(min(max(number, -MAX_NUMBER), MAX_NUMBER))


def _find_numbers(meter: Meter, text: Any) -> list[float]:
    """Return the numbers in a text, in their order: 3, -1.5, 2e-3, and the 20 of 20%; but not the 3 of v3. A comma is between numbers."""
    if not isinstance(text, str):
        raise TypeError(f"find_numbers takes a text, not {describe(text)}")
    meter.pay(len(text))
    numbers = [_bound(float(match[0])) for match in NUMBER.finditer(text)][:MAX_FOUND_NUMBERS]
    return meter.pay_for_list(numbers)


def _check_events(events: Any) -> dict[str, float]:
    if type(events) is not dict:
        raise RefusedError("E-FORM", f"{TURN_FUNCTION_NAME} must return a dictionary of events, not {describe(events)}")
    if not 1 <= len(events) <= MAX_FACTORS:
        raise RefusedError("E-FORM", f"{TURN_FUNCTION_NAME} must return 1 to {MAX_FACTORS} events, not {len(events)}")
    result = {}
    for name, value in events.items():
        if not is_name(name):
            raise RefusedError("E-FORM", f"the name of an event must be {NAME_RULE}, and is {short_repr(name)}")
        if not isinstance(value, bool | int | float):
            raise RefusedError("E-FORM", f"the event {name!r} must be a number or a truth value, not {describe(value)}")
        if not abs(value) <= MAX_EVENT_VALUE:
            limits = f"between -{MAX_EVENT_VALUE:g} and {MAX_EVENT_VALUE:g}"
            raise RefusedError("E-FORM", f"the event {name!r} must be {limits}, and is {value:g}")
        result[name] = float(value)
    return result
