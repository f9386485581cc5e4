"""Functions that replace Python's and NumPy's own functions in a program. Their results are bounded, and their arrays hold numbers
only.

Without them, a single call could make huge values: `*` and `**` on integers, and everything that joins or repeats sequences.
Arrays of objects or strings would bypass all other guards.
"""

import builtins
import itertools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from lare.latent.language.allowed import SHAPING, SIZES

FUEL = 20_000
"""The most loop iterations and function calls in one call of a program, and the most entries that one function iterates over."""

LONGEST_SEQUENCE = 10_000
LARGEST_BITS, LARGEST_ENTRY = 4096, 64
"""The most bits of an integer, and of an integer in an array."""

LARGEST_SIZE = 1 << 25
"""The most numbers in an array: eight thousand for each row of the largest batch."""

MOST_TURNS = 1000
"""The most repetitions of NumPy's sequential operations: the order of `np.diff`, the pieces of `np.split`."""

MOST_ENTRIES, DEEPEST = 50_000, 32
"""The most entries and the most levels of nested lists."""

NESTING = (list, tuple, dict)
SEQUENCES = (list, tuple, str)
INTEGERS = (int, np.integer)


class TooLarge(Exception):
    """A number or a sequence would exceed its bound."""


def numbers(value: Any) -> Any:
    """Returns the value, unless it is an array that holds something other than numbers, or is too large."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "fiubc":
        raise TypeError(f"arrays hold numbers only, not {value.dtype}")
    if isinstance(value, np.ndarray) and value.size > LARGEST_SIZE:
        raise TooLarge(f"an array of {value.size} numbers")
    return value


def few(value: Any) -> Any:
    """Returns the value, unless its nested lists have too many entries or levels.

    If each list holds another list twice, the number of entries grows exponentially. Functions that compare, hash or convert to
    arrays visit all entries, and recurse once per level.
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
    """Refuses integers that no array of numbers can hold. NumPy would make arrays of objects, whose arithmetic is unbounded."""
    for value in values:
        if isinstance(value, list | tuple):
            check_entries(value)
        elif isinstance(value, int) and value.bit_length() > LARGEST_ENTRY:
            raise TooLarge("an integer that no array holds")


def size(value: Any, most: int = LARGEST_SIZE) -> Any:
    """Returns a size or a number of repetitions, unless it is too large. NumPy would compute with it before checking it."""
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
    """A NumPy function whose arguments are bounded, and whose results are numbers."""
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
    """Returns the argument of `out=` if it is an array. Without an array, `where=` would return uninitialised memory."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"out= must be an array, not a {type(value).__name__}")
    return value


def dtype_of(value: Any) -> Any:
    return numbers(value).dtype


def rounded(value: Any, digits: int = 0) -> Any:
    """Python's `round` with a bounded number of digits. It could otherwise compute 10 to the power of a million."""
    if not isinstance(digits, int) or abs(digits) > 300:
        raise TooLarge("round to so many digits")
    return builtins.round(value, digits) if digits else builtins.round(value)


def total(values: Any, start: Any = 0) -> Any:
    """Python's `sum`, but not of sequences, which it would join repeatedly."""
    if isinstance(start, SEQUENCES):
        raise TooLarge("a sum of sequences")
    return numbers(of_few(builtins.sum)(values, start))


def extend(target: Any, values: Any) -> None:
    """`list.extend`, but only by a list or tuple. A list that is extended by its own iterator would grow forever."""
    if not isinstance(target, list) or not isinstance(values, list | tuple):
        raise TypeError("extend takes a list")
    check_joined(target, values)
    target.extend(values)


def at_once(function: Callable[..., Any]) -> Callable[..., list[Any]]:
    """A function that returns a list instead of an iterator: iterators of iterators could be deep without any loop."""
    guarded_function = of_few(function)
    return lambda *arguments, **keywords: list(guarded_function(*arguments, **keywords))


def of_few(function: Callable[..., Any]) -> Callable[..., Any]:
    """A Python function that iterates over its arguments, with a bound on their entries."""

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
                return  # NumPy converts the list to an array
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
"""Each operator, and its in-place version."""


def guarded(name: str, function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """An operator whose results are bounded."""
    check = CHECKED.get(name, lambda left, right: None)

    def call(left: Any, right: Any) -> Any:
        check(left, right)
        return numbers(function(left, right))

    return call
