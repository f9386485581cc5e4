"""The values of a program that are neither numbers nor arrays: names, functions, classes, scopes."""

from __future__ import annotations

import ast
import builtins
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from lare_rl.phi.batch_axis import BatchSize
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.operand import Operand


class _Value:
    """A value whose text tells nothing about the process."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__.lower()}>"


@dataclass(frozen=True)
class Symbol:
    """A module, a function or a type of Python or NumPy. A program has only its name."""

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
    """A function, or a method of a type of Python or NumPy, with its first argument."""

    call: Callable[..., Any]


@dataclass(eq=False, repr=False)
class Decorated(_Value):
    """A static method, a class method, a property, or the `default_factory` of a dataclass's field."""

    kind: str
    function: Any


@dataclass(eq=False, repr=False)
class Class(_Value):
    """A class of the program."""

    name: str
    attributes: dict[str, Any]
    bases: Sequence[Class] = ()
    fields: Sequence[str] | None = None
    """Names of the fields of a dataclass or of a named tuple, in order."""
    is_tuple: bool = False
    is_dataclass: bool = False

    def find(self, name: str) -> Any:
        """Return an attribute of the class or of its bases. Raises `AttributeError` if none of them has it."""
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
    bound_to: Any = None
    """For `super()`: the object, or the class, that its methods are called on."""


class Set(dict):
    """A set of the program. It keeps the order in which its entries were added."""

    __hash__ = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Set) and self.keys() == other.keys()

    def __ne__(self, other: object) -> bool:
        return not self == other

    @property
    def entries(self) -> list[Any]:
        """The entries in the order of CPython, if all are numbers. That of texts differs from process to process.

        Raises `RefusedError` if the order of numbers depends on how the set was made.
        """
        if not all(isinstance(entry, (bool, int, float)) for entry in self):
            return list(self)
        rising, falling = sorted(self), sorted(self, reverse=True)
        ways = set(self), set(rising), set(falling), set(frozenset(self)), frozenset(self)
        first, *orders = map(list, ways)
        if any(order != first for order in orders):
            raise RefusedError("E-PYTHON", "the order of the entries of a set is not certain: use sorted()")
        return first


class FrozenSet(Set):
    """A frozenset of the program."""


class Keys(Set):
    """The keys of a dictionary, in its order."""

    @property
    def entries(self) -> list[Any]:
        return list(self)


class Iterator(list):
    """The result of zip, map, a generator and the like. Its entries can be read once."""

    def read(self) -> Iterable[Any]:
        """Yield the entries one by one, and remove each. If the caller stops, the other entries stay."""
        while self:
            yield self.pop(0)


class Scope(dict):
    """The names of a module, a call, a class or a comprehension. Other names are searched in the scopes around it."""

    def __init__(self, parent: Scope | None = None, kind: str = "function"):
        super().__init__()
        self.parent, self.kind = parent, kind
        self.elsewhere: dict[str, Scope] = {}
        """The scopes of names that are declared global or nonlocal."""
        self.yielded: list[Any] | None = None
        """What a generator has yielded so far; None in other functions."""
        self.owner: Class | None = None
        """The class whose method is called."""
        self.instance: Any = None
        """The object that the method is called on."""

    def find(self, name: str) -> Any:
        """Return the value of a name. Raises `NameError` if it is not defined, `RefusedError` for a function of Python that is missing."""
        scope: Scope | None = self
        while scope is not None:
            if name in scope.elsewhere:
                scope = scope.elsewhere[name]
            if name in scope:
                return scope[name]
            scope = scope.parent
        if hasattr(builtins, name):
            raise RefusedError("E-PYTHON", f"{name} is not available")
        raise NameError(name)

    def assign(self, name: str, value: Any) -> None:
        self.elsewhere.get(name, self)[name] = value

    @property
    def function(self) -> Scope:
        """The scope of the function around a comprehension."""
        return self.parent.function if self.kind == "comprehension" and self.parent is not None else self

    @property
    def closure(self) -> Scope:
        """The scope around the functions that are defined here. A method does not see the names of its class."""
        return self.parent if self.kind == "class" and self.parent is not None else self


class ReturnSignal(Exception):
    """Leaves a function of the program."""

    def __init__(self, value: Any):
        super().__init__()
        self.value = value


class BreakSignal(Exception):
    """Leaves a loop."""


class ContinueSignal(Exception):
    """Goes on with the next turn of a loop."""


class ProgramError(Exception):
    """The program raised an error. `name` is that of its class."""

    def __init__(self, name: str, message: str):
        super().__init__(f"the program raises {name}{': ' + message if message else ''}")
        self.name, self.message = name, message


PYTHON_ERRORS = (ArithmeticError, AttributeError, LookupError, NameError, TypeError, ValueError, ProgramError)
"""The errors that Python and NumPy would raise, too. A program can catch them; it cannot catch `RefusedError`."""

_TYPE_NAMES: dict[type, str] = {
    Set: "set", FrozenSet: "frozenset", Keys: "dict_keys", Iterator: "iterator", Bound: "function", Function: "function",
    Class: "type", Symbol: "type", BatchSize: "int",
}  # fmt: skip


def value_type(value: Any) -> Symbol:
    """Return the type of a value, as a program sees it."""
    if isinstance(value, Operand):
        return Symbol("np.ndarray")
    if isinstance(value, Instance):
        return Symbol(value.cls.name)
    return Symbol(_TYPE_NAMES.get(type(value), type(value).__name__))


def describe(value: Any) -> str:
    """Return what a value is, for a message: np.sin, a list, an array."""
    if value is None or isinstance(value, Symbol):
        return str(value)
    name = "array" if isinstance(value, Operand) else value_type(value).name
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
