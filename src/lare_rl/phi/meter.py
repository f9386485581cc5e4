"""What a program may spend. Everything that takes time or memory is paid for before it happens."""

from collections.abc import Iterable, Sequence
from typing import Any

from lare_rl.phi.limits import MAX_INT_BITS, MAX_KEY_LENGTH, MAX_LIST_LENGTH, MAX_STEPS, MAX_TEXT_LENGTH, RefusedError
from lare_rl.phi.values import Instance, Symbol


class Meter:
    """Counts the steps of a program."""

    def __init__(self) -> None:
        self.steps = 0

    def pay(self, steps: int = 1) -> None:
        self.steps += max(steps, 0)
        if self.steps > MAX_STEPS:
            raise RefusedError("E-COST", f"the program takes more than {MAX_STEPS} steps")

    def pay_for_list(self, values: Sequence[Any] | int) -> Any:
        """Pay for a new list with these entries, or of this length, and return it."""
        length = values if isinstance(values, int) else len(values)
        if length > MAX_LIST_LENGTH:
            raise RefusedError("E-COST", f"a list is too long: it may have at most {MAX_LIST_LENGTH} entries")
        self.pay(length)
        return values

    def pay_for_all_within(self, values: Iterable[Any]) -> None:
        """Pay for values and all that they contain. A list that holds another one twice, and so on, has very many entries."""
        stack = list(values)
        while stack:
            value = stack.pop()
            self.pay()
            if isinstance(value, dict):
                self.pay(len(value))
                stack.extend(value.values())
            elif isinstance(value, (list, tuple)):
                stack.extend(value)
            elif isinstance(value, slice):
                stack.extend((value.start, value.stop, value.step))
            elif isinstance(value, str):
                self.pay(len(value) // 100)
            elif isinstance(value, Instance):
                stack.extend(value.attributes.values())


def check_number(value: Any) -> Any:
    """Return a number. Raises `RefusedError` for an integer that is too large."""
    if isinstance(value, int) and value.bit_length() > MAX_INT_BITS:
        raise RefusedError("E-COST", "an integer is too large")
    return value


def check_text_length(length: int) -> None:
    """Raise `RefusedError` if a text of this length, which need not exist yet, is too long."""
    if length > MAX_TEXT_LENGTH:
        raise RefusedError("E-COST", f"a text is too long: it may have at most {MAX_TEXT_LENGTH} characters")


def check_text(text: str) -> str:
    check_text_length(len(text))
    return text


def check_key(value: Any) -> Any:
    """Return a value that can be the key of a dictionary. Raises `TypeError` for others."""
    items = value if isinstance(value, tuple) else (value,)
    if len(items) > MAX_KEY_LENGTH or not all(
        isinstance(item, (str, bool, int, float, Symbol)) or item is None for item in items
    ):
        raise TypeError("the keys of dictionaries and the entries of sets are texts, numbers, or tuples of them")
    return value
