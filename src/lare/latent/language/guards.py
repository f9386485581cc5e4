"""Functions that a program gets in place of Python's and NumPy's own: no single call can make an array of any size, and nothing
becomes something else than numbers.

What can grow that way are `*` and `**` on integers, and whatever joins or repeats sequences. Arrays of objects and strings would
lead around every other guard.
"""

import builtins
import itertools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lare.latent.language.allowed import SHAPING, SIZES

FUEL = 20_000
"""Turns of loops, and calls, of one call of a program; and entries of what is gone through at once."""

LONGEST_SEQUENCE = 10_000
LARGEST_BITS, LARGEST_ENTRY = 4096, 64
"""Bits of an integer, and of one in an array."""

LARGEST_SIZE = 1 << 25
"""Numbers in an array: eight thousand for each row of the largest batch."""

MOST_TURNS = 1000
"""Of what NumPy does one after the other: differences, pieces."""

MOST_ENTRIES, DEEPEST = 50_000, 32
"""Of lists within lists."""

NESTING = (list, tuple, dict)
SEQUENCES = (list, tuple, str)
INTEGERS = (int, np.integer)


class TooLarge(Exception):
    """A number or a sequence would grow beyond all bounds."""


def numbers(value: Any) -> Any:
    """The value, where it is not an array of anything else."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "fiubc":
        raise TypeError(f"arrays hold numbers only, not {value.dtype}")
    if isinstance(value, np.ndarray) and value.size > LARGEST_SIZE:
        raise TooLarge(f"an array of {value.size} numbers")
    return value


def few(value: Any) -> Any:
    """The value, where lists within it are few and not deep: one that holds another twice, and so on, has entries without end.

    Whoever compares, hashes or makes arrays goes through all of them, and takes to its own stack for what is deep.
    """
    level, left = [value], MOST_ENTRIES
    for _ in range(DEEPEST):
        nested = [one for one in level if isinstance(one, NESTING)]
        if not nested:
            return value
        level = list(itertools.islice(itertools.chain.from_iterable(map(entries, nested)), left + 1))
        left -= len(level)
        if left < 0:
            raise TooLarge(f"more than {MOST_ENTRIES} entries within each other")
    raise TooLarge(f"lists are nested more than {DEEPEST} deep")


def entries(value: Any) -> Iterable[Any]:
    return (*value, *value.values()) if isinstance(value, dict) else value


def check_entries(values: Iterable[Any]) -> None:
    """NumPy makes arrays of objects of what no array of numbers holds, and reckons with it without end."""
    for value in values:
        if isinstance(value, list | tuple):
            check_entries(value)
        elif isinstance(value, int) and value.bit_length() > LARGEST_ENTRY:
            raise TooLarge("an integer that no array holds")


def size(value: Any, most: int = LARGEST_SIZE) -> Any:
    """What says how large an array is to be, or how often something is done: NumPy reckons with it before it looks."""
    if isinstance(value, list | tuple):
        for one in value:
            size(one, most)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "iu" and value.size and int(np.asarray(value).max()) > most:
            raise TooLarge(f"a size above {most}")
    elif isinstance(value, INTEGERS) and value > most:
        raise TooLarge(f"a size above {most}")
    return value


def only_numbers(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """A NumPy function of numbers, whose results are numbers."""
    places = SHAPING.get(name.removeprefix("numpy."), ())
    most = MOST_TURNS if name in ("numpy.diff", "numpy.split") else LARGEST_SIZE

    def call(*arguments: Any, **keywords: Any) -> Any:
        given = [*arguments, *keywords.values()]
        few(given)
        check_entries(given)
        for place in places:
            size(arguments[place] if place < len(arguments) else 0, most)
        for key in keywords.keys() & SIZES:
            size(keywords[key], most)
        return numbers(function(*arguments, **keywords))

    return call


def array_only(value: Any) -> np.ndarray:
    """What `out=` may be: without an array there, `where=` leaves memory that nobody has written."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"out= must be an array, not a {type(value).__name__}")
    return value


def dtype_of(value: Any) -> Any:
    return numbers(value).dtype


def rounded(value: Any, digits: int = 0) -> Any:
    """Python's own round would compute 10 to the power of a million."""
    if not isinstance(digits, int) or abs(digits) > 300:
        raise TooLarge("round to so many digits")
    return builtins.round(value, digits) if digits else builtins.round(value)


def total(values: Any, start: Any = 0) -> Any:
    """Python's own sum joins lists, again and again."""
    if isinstance(start, SEQUENCES):
        raise TooLarge("a sum of sequences")
    return numbers(of_few(builtins.sum)(values, start))


def extend(target: Any, values: Any) -> None:
    """A list feeds on itself if it is extended by its own iterator."""
    if not isinstance(target, list) or not isinstance(values, list | tuple):
        raise TypeError("extend takes a list")
    check_joined(target, values)
    target.extend(values)


def at_once(function: Callable[..., Any]) -> Callable[..., list[Any]]:
    """A function that gives an iterator, as a list: iterators of iterators go deep without a loop."""
    guarded_function = of_few(function)
    return lambda *arguments, **keywords: list(guarded_function(*arguments, **keywords))


def of_few(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of Python's that goes through its arguments, one entry after the other."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        for argument in arguments:
            if hasattr(argument, "__len__") and not (isinstance(argument, np.ndarray) and not argument.ndim):
                bounded(argument)
        few(arguments)
        return function(*arguments, **keywords)

    return call


def bounded(sequence: Any) -> Any:
    if len(sequence) > FUEL:
        raise TooLarge(f"a sequence of {len(sequence)} entries")
    return sequence


def check_joined(left: Any, right: Any) -> None:
    if isinstance(left, SEQUENCES):
        if not isinstance(right, SEQUENCES):
            if isinstance(right, np.ndarray | np.generic):
                return  # NumPy takes the list for an array
            raise TypeError(f"a {type(left).__name__} and a {type(right).__name__} cannot be joined")
        if len(left) + len(right) > LONGEST_SEQUENCE:
            raise TooLarge(f"a sequence of {len(left) + len(right)} entries")


def check_repeated(left: Any, right: Any) -> None:
    for one, times in ((left, right), (right, left)):
        if isinstance(one, SEQUENCES) and isinstance(times, INTEGERS) and len(one) * int(times) > LONGEST_SEQUENCE:
            raise TooLarge(f"a sequence of {len(one)} entries, {times} times")
        if isinstance(one, SEQUENCES) and isinstance(times, np.integer):
            raise TypeError(f"a {type(one).__name__} is repeated by a number of NumPy's: make it an array first")
    if isinstance(left, int) and isinstance(right, int) and left.bit_length() + right.bit_length() > LARGEST_BITS:
        raise TooLarge("a product of huge integers")


def check_power(base: Any, exponent: Any) -> None:
    if isinstance(base, int) and isinstance(exponent, int) and base.bit_length() * abs(exponent) > LARGEST_BITS:
        raise TooLarge("a power of integers")


CHECKED = {"add": check_joined, "multiply": check_repeated, "power": check_power}

OPERATORS: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]] = {
    "add": (operator.add, operator.iadd),
    "subtract": (operator.sub, operator.isub),
    "multiply": (operator.mul, operator.imul),
    "divide": (operator.truediv, operator.itruediv),
    "floor_divide": (operator.floordiv, operator.ifloordiv),
    "remainder": (operator.mod, operator.imod),
    "power": (operator.pow, operator.ipow),
    "matmul": (operator.matmul, operator.imatmul),
    "and": (operator.and_, operator.iand),
    "or": (operator.or_, operator.ior),
    "xor": (operator.xor, operator.ixor),
}
"""Each operator, and what it does in place."""


def guarded(name: str, function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """An operator that lets nothing grow without bound."""
    check = CHECKED.get(name, lambda left, right: None)

    def call(left: Any, right: Any) -> Any:
        check(left, right)
        return numbers(function(left, right))

    return call
