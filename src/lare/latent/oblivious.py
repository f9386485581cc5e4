"""Arrays that refuse to be looked into, to find control flow that depends on values.

A latent function judges a whole batch at once; an `if` on a value would decide for every row by one of them. A program
that runs through on these arrays takes the same way through its code whatever the values are.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Never

import numpy as np

from lare.latent.language import DOTTED, METHODS
from lare.latent.program import CALLED_TYPES, OPERATORS, namespace, only_numbers, resolve


class Looked(Exception):
    """A value of a batch was asked for, where only the whole batch may be reckoned with."""


class Missing(Exception):
    """An entry was asked for that there is not. NumPy itself lets a slice end anywhere."""


class Oblivious(np.ndarray):
    """An array whose values cannot decide anything. Everything computed from it is one as well."""

    def __bool__(self) -> Never:
        raise Looked("a decision depends on values of the batch: use np.where instead of if, and, or, max, min")

    def __int__(self) -> Never:
        raise Looked("a value of the batch is turned into one number: keep it an array")

    def __float__(self) -> Never:
        raise Looked("a value of the batch is turned into one number: keep it an array, and use np instead of math")

    def __index__(self) -> Never:
        raise Looked("a value of the batch is used as an index: use np.where or np.take_along_axis")

    def __getitem__(self, key: Any) -> Any:
        check_slices(key, self.shape)
        if any(isinstance(part, Oblivious) for part in (key if isinstance(key, tuple) else (key,))):
            raise Looked("an array is indexed by values of the batch: use np.where or np.take_along_axis")
        return hidden(super().__getitem__(key))

    def __getattribute__(self, name: str) -> Any:
        if name in METHODS:
            return careful(getattr(self.view(np.ndarray), name), SHAPING_METHODS.get(name, ()), self)
        return super().__getattribute__(name)

    def __array_wrap__(self, array: np.ndarray, context: Any = None, return_scalar: bool = False) -> Any:
        return hidden(array)


def check_slices(key: Any, shape: tuple[int, ...]) -> None:
    """Slices of anything but rows must lie within the array; past its end they would silently be empty."""
    parts = key if isinstance(key, tuple) else (key,)
    for part, size in list(zip(parts, shape, strict=False))[1:]:
        if part is None or part is Ellipsis:
            return
        if isinstance(part, slice):
            for end in (part.start, part.stop):
                if isinstance(end, int) and not -size <= end <= size:
                    raise Missing(f"the slice {part.start}:{part.stop} reaches past the {size} entries that there are")


def hidden(value: Any) -> Any:
    """The same values, not to be looked into."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value).view(Oblivious)
    if isinstance(value, list | tuple):
        return type(value)(hidden(one) for one in value)
    return value


def shown(value: Any) -> Any:
    """The same values as an ordinary array."""
    if isinstance(value, Oblivious):
        return value.view(np.ndarray)
    if isinstance(value, list | tuple):
        return type(value)(shown(one) for one in value)
    return value


def touched(arguments: Iterable[Any]) -> bool:
    """Whether one of some values, or of the values in them, is hidden."""
    return any(isinstance(one, Oblivious) or (isinstance(one, list | tuple) and touched(one)) for one in arguments)


def careful(function: Callable[..., Any], shaping: tuple[int, ...] = (), *owners: Any) -> Callable[..., Any]:
    """A function whose result is hidden where one of its arguments, or its owner, is. NumPy itself may look.

    The arguments at the places `shaping` say what shape the result has, and must not be hidden.
    """

    def call(*arguments: Any, **keywords: Any) -> Any:
        sizes = [argument for place, argument in enumerate(arguments) if place in shaping]
        if shaping and touched([*sizes, *(keywords[key] for key in keywords.keys() & SIZES)]):
            raise Looked("the shape of an array depends on values of the batch: use np.where, which keeps every row")
        result = function(*shown(arguments), **{name: shown(value) for name, value in keywords.items()})
        return hidden(result) if touched([*owners, *arguments, *keywords.values()]) else result

    return call


TELLING = {"numpy.shape", "numpy.ndim", "numpy.size", "numpy.finfo"}
"""Functions that tell nothing of values."""

SHAPING = {
    **dict.fromkeys("zeros ones full identity".split(), (0,)),
    **dict.fromkeys("repeat tile reshape broadcast_to split pad".split(), (1,)),
    "arange": (0, 1, 2),
    "linspace": (2,),
    "eye": (0, 1),
}
"""Functions of NumPy some of whose arguments say what shape the result has, and which."""

SHAPING_METHODS = {"repeat": (0,), "reshape": tuple(range(8))}
SIZES = {"shape", "num", "N", "M", "repeats", "indices_or_sections", "pad_width"}
"""Keywords that do."""


def careful_functions() -> Mapping[str, Callable[..., Any]]:
    """The NumPy functions of the language, for `Program`. Some of them would forget whom their arguments were."""
    names = DOTTED.keys() - TELLING - CALLED_TYPES
    functions = {
        name: careful(only_numbers(resolve(name)), SHAPING.get(name.removeprefix("numpy."), ()))
        for name in names
        if name.startswith("numpy.")
    }
    functions |= {f"{name}()": careful(resolve(name)) for name in CALLED_TYPES}
    # What takes a hidden array in is hidden from then on.
    return functions | {f"$i{name}": careful(namespace()[f"$i{name}"]) for name in OPERATORS}
