"""The values of a program that are neither numbers nor arrays, and what a program may spend."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from lare_rl.phi.arrays import BatchSize, Operand
from lare_rl.phi.graph import Refused

MOST_STEPS = 40_000
"""The most steps of a program: statements, expressions, and entries of lists that are made or looked into."""
LONGEST_LIST = 10_000
LONGEST_TEXT = 10_000
LONGEST_KEY = 16
"""The most entries of a tuple that is the key of a dictionary."""
MOST_BITS = 63
"""The most bits of an integer."""


class _Value:
    """A value whose text tells nothing of the process."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__.lower()}>"


@dataclass(frozen=True)
class Named:
    """What is known by its name: a module, a function or a type of Python or NumPy."""

    name: str

    def __str__(self) -> str:
        return self.name


@dataclass(eq=False, repr=False)
class Function(_Value):
    """A function of the program."""

    name: str
    parameters: ast.arguments
    body: Sequence[ast.stmt] | ast.expr
    scope: Scope
    defaults: Sequence[Any]
    keyword_defaults: Sequence[Any]
    yields: bool = False
    owner: Class | None = None
    """The class whose method it is."""


@dataclass(eq=False, repr=False)
class Bound(_Value):
    """A function, or a method of Python's or NumPy's types, with its first argument."""

    call: Callable[..., Any]


@dataclass(eq=False, repr=False)
class Decorated(_Value):
    """A function in a class: a static method, a class method or a property."""

    kind: str
    function: Any


@dataclass(eq=False, repr=False)
class Class(_Value):
    """A class of the program."""

    name: str
    attributes: dict[str, Any]
    bases: Sequence[Class] = ()
    fields: Sequence[str] | None = None
    """The names of the fields of a dataclass or of a named tuple, in order."""
    is_tuple: bool = False

    def find(self, name: str) -> Any:
        """An attribute, also of the bases. Raises `AttributeError` if there is none."""
        for cls in (self, *self.bases):
            if name in cls.attributes:
                return cls.attributes[name]
        raise AttributeError(f"{self.name} has no attribute {name!r}")

    def has(self, name: str) -> bool:
        return any(name in cls.attributes for cls in (self, *self.bases))


@dataclass(eq=False, repr=False)
class Instance(_Value):
    """An object of a class of the program."""

    cls: Class
    attributes: dict[str, Any] = field(default_factory=dict)


class Set(dict):
    """A set of the program. It keeps the order in which its entries were added."""


class Iterator(list):
    """What zip, map, a generator and their like return. Its entries can be gone through once."""


class Scope(dict):
    """The names of a call, of a class or of a comprehension, within those of the scopes around it."""

    def __init__(self, parent: Scope | None = None, kind: str = "function"):
        super().__init__()
        self.parent, self.kind = parent, kind
        self.elsewhere: dict[str, Scope] = {}
        """The scopes of names that are declared global or nonlocal."""
        self.yielded: list[Any] | None = None
        """What a generator has yielded."""
        self.owner: Class | None = None
        """The class whose method is called."""
        self.instance: Any = None
        """The object that the method is called on."""

    def find(self, name: str) -> Any:
        """The value of a name. Raises `NameError` if there is none."""
        scope: Scope | None = self
        while scope is not None:
            if name in scope.elsewhere:
                scope = scope.elsewhere[name]
            if name in scope:
                return scope[name]
            scope = scope.parent
        raise NameError(name)

    def assign(self, name: str, value: Any) -> None:
        self.elsewhere.get(name, self)[name] = value

    @property
    def function(self) -> Scope:
        """The scope of the function around a comprehension."""
        return self.parent.function if self.kind == "comprehension" and self.parent is not None else self

    @property
    def closure(self) -> Scope:
        """The scope that functions see which are defined here: not that of a class."""
        return self.parent if self.kind == "class" and self.parent is not None else self


class Meter:
    """Counts the steps of a program. All that takes time or memory is paid for before it happens."""

    def __init__(self) -> None:
        self.steps = 0

    def pay(self, steps: int = 1) -> None:
        self.steps += max(steps, 0)
        if self.steps > MOST_STEPS:
            raise Refused("E-COST", f"the program takes more than {MOST_STEPS} steps")

    def pay_for_list(self, values: Sequence[Any] | int) -> Any:
        """Pay for a new list of these entries, or of this many, and return it."""
        count = values if isinstance(values, int) else len(values)
        if count > LONGEST_LIST:
            raise Refused("E-COST", f"a list is too long: it may have at most {LONGEST_LIST} entries")
        self.pay(count)
        return values

    def pay_for_all_within(self, values: Iterable[Any]) -> None:
        """Pay for all that is within values. A list that holds another twice, and so on, has very many entries."""
        rest = list(values)
        while rest:
            value = rest.pop()
            self.pay()
            if isinstance(value, dict):
                self.pay(len(value))
                rest.extend(value.values())
            elif isinstance(value, (list, tuple)):
                rest.extend(value)
            elif isinstance(value, slice):
                rest.extend((value.start, value.stop, value.step))
            elif isinstance(value, str):
                self.pay(len(value) // 100)
            elif isinstance(value, Instance):
                rest.extend(value.attributes.values())


def checked_number(value: Any) -> Any:
    """A number of Python. Raises `Refused` if it is too large."""
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        raise Refused("E-COST", "an integer is too large")
    return value


def check_text_length(length: int) -> None:
    """Raises `Refused` if a text of this length, which need not be made yet, is too long."""
    if length > LONGEST_TEXT:
        raise Refused("E-COST", f"a text is too long: it may have at most {LONGEST_TEXT} characters")


def checked_text(text: str) -> str:
    check_text_length(len(text))
    return text


def as_key(value: Any) -> Any:
    """A value as the key of a dictionary. Raises `TypeError` if it is none."""
    parts = value if isinstance(value, tuple) else (value,)
    if len(parts) > LONGEST_KEY or not all(
        isinstance(part, (str, bool, int, float, Named)) or part is None for part in parts
    ):
        raise TypeError("the keys of dictionaries and the entries of sets are texts, numbers, or tuples of them")
    return value


class Return(Exception):
    """Leaves a function of the program."""

    def __init__(self, value: Any):
        super().__init__()
        self.value = value


class Break(Exception):
    """Leaves a loop."""


class Continue(Exception):
    """Goes on with the next turn of a loop."""


class Raised(Exception):
    """The program raised an error. `name` is that of its class."""

    def __init__(self, name: str, message: str):
        super().__init__(f"the program raises {name}{': ' + message if message else ''}")
        self.name, self.message = name, message


def type_of(value: Any) -> Named:
    """The type of a value, as a program sees it."""
    if isinstance(value, Operand):
        return Named("np.ndarray")
    if isinstance(value, Instance):
        return Named(value.cls.name)
    names = {
        Set: "set",
        Iterator: "iterator",
        Bound: "function",
        Class: "type",
        BatchSize: "int",
        Named: "type",
        Function: "function",
    }
    return Named(names.get(type(value), type(value).__name__))
