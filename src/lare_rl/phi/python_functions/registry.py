"""The functions of Python and of its modules that a program can call, by name. Nothing else of Python can be reached.

A function takes the interpreter first (`Runtime`), then the arguments of the program.
"""

from collections.abc import Callable, Iterable
from typing import Any

from lare_rl.phi.arrays import Array

__all__ = ["BUILTINS", "builtin", "varies"]

BUILTINS: dict[str, Callable[..., Any]] = {}
"""All functions, by names such as "len", "math.sqrt", "itertools.product"."""


def builtin(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function of Python under these names."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        BUILTINS.update(dict.fromkeys(names, function))
        return function

    return register


def varies(values: Iterable[Any]) -> bool:
    """Return whether one of the values is an array that differs from row to row."""
    return any(isinstance(value, Array) and value.constant is None for value in values)
