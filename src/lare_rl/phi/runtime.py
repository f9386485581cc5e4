"""The interface of the interpreter, which the functions of Python take as their first argument; and what a program may spend.

Everything that takes time or memory is paid for before it happens.
"""

import ast
import functools
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from lare_rl.phi.arrays import Array
from lare_rl.phi.builder import Builder
from lare_rl.phi.limits import MAX_INT_BITS, MAX_KEY_LENGTH, MAX_LIST_LENGTH, MAX_STEPS, MAX_TEXT_LENGTH, RefusedError
from lare_rl.phi.values import Instance, Iterator, Scope, Set, Symbol

__all__ = [
    "BINARY", "BUILTINS", "Meter", "Runtime", "builtin", "builtin_variants", "check_key", "check_number", "check_text",
    "check_text_length", "make_set", "varies",
]  # fmt: skip


class Meter:
    """Counts the steps of a program."""

    def __init__(self, max_steps: int = MAX_STEPS) -> None:
        self.steps, self.max_steps = 0, max_steps

    def pay(self, steps: int = 1) -> None:
        self.steps += max(steps, 0)
        if self.steps > self.max_steps:
            raise RefusedError("E-COST", f"the program takes more than {self.max_steps} steps")

    def pay_for_list(self, values: Sequence[Any] | int) -> Any:
        """Pay for a new list with these entries, or of this length, and return it."""
        length = values if isinstance(values, int) else len(values)
        if length > MAX_LIST_LENGTH:
            raise RefusedError("E-COST", f"a list is too long: it may have at most {MAX_LIST_LENGTH} entries")
        self.pay(length)
        return values

    def pay_for_all_within(self, values: Iterable[Any]) -> None:
        """Pay for values and all that they contain: a list of two lists of two lists ... has very many entries."""
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
    """Raise `RefusedError` if a text of this length, which is yet to be made, is too long."""
    if length > MAX_TEXT_LENGTH:
        raise RefusedError("E-COST", f"a text is too long: it may have at most {MAX_TEXT_LENGTH} characters")


def check_text(text: str) -> str:
    check_text_length(len(text))
    return text


def check_key(value: Any) -> Any:
    """Return a value that can be the key of a dictionary. Raises `TypeError` for others."""
    if isinstance(value, Array) and value.is_number:
        value = value.number()
    items = value if isinstance(value, tuple) else (value,)
    if len(items) > MAX_KEY_LENGTH or not all(
        isinstance(item, (str, bool, int, float, Symbol)) or item is None for item in items
    ):
        raise TypeError("the keys of dictionaries and the entries of sets are texts, numbers, or tuples of them")
    return value


def make_set(values: Iterable[Any]) -> Set:
    return Set(dict.fromkeys(map(check_key, values)))


class Runtime(ABC):
    """A program that is being carried out. `Interpreter` says where each method is defined."""

    builder: Builder
    meter: Meter
    module: Scope
    line: int
    """Line of the present statement."""
    call_depth: int

    def next_items(self, value: Any) -> Iterable[Any]:
        """Return the entries that a loop goes through. A loop that is left early leaves the others in an iterator."""
        if not isinstance(value, Iterator):
            return self.items(value)
        self.meter.pay(len(value) * (1 + len(value) // 100))
        return value.read()

    @abstractmethod
    def run(self, statements: Iterable[ast.stmt], scope: Scope, /) -> None: ...
    @abstractmethod
    def assign(self, target: ast.expr, value: Any, scope: Scope, /) -> None: ...
    @abstractmethod
    def evaluate(self, node: ast.expr, scope: Scope, /) -> Any: ...
    @abstractmethod
    def binary(self, op: ast.operator, x: Any, y: Any, /) -> Any: ...
    @abstractmethod
    def item(self, container: Any, index: Any, /) -> Any: ...
    @abstractmethod
    def items(self, value: Any, /) -> Sequence[Any]: ...
    @abstractmethod
    def truth(self, value: Any, /) -> bool: ...
    @abstractmethod
    def attribute(self, owner: Any, name: str, /) -> Any: ...
    @abstractmethod
    def call(self, function: Any, args: Sequence[Any], kwargs: Mapping[str, Any], /) -> Any: ...


BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv, ast.Mod: operator.mod,
    ast.FloorDiv: operator.floordiv, ast.Pow: operator.pow, ast.BitAnd: operator.and_, ast.BitOr: operator.or_,
    ast.BitXor: operator.xor, ast.LShift: operator.lshift, ast.RShift: operator.rshift, ast.MatMult: operator.matmul,
}  # fmt: skip


# --- the functions of Python -----------------------------------------------------------------------------------------


BUILTINS: dict[str, Callable[..., Any]] = {}
"""Functions of Python, by names such as "len", "math.sqrt", "itertools.product"."""


def builtin(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function of Python under these names."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        BUILTINS.update(dict.fromkeys(names, function))
        return function

    return register


def builtin_variants(table: Mapping[str, Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function under each name of a table, whose value it takes before the runtime."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        BUILTINS.update({name: functools.partial(function, variant) for name, variant in table.items()})
        return function

    return register


def varies(values: Iterable[Any]) -> bool:
    """Return whether one of the values is an array that differs from row to row."""
    return any(isinstance(value, Array) and value.constant is None for value in values)
