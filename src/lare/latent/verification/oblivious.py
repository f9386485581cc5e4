"""Arrays that refuse to be looked into, to find control flow that depends on values.

A latent function judges a whole batch at once; an `if` on a value would decide for every row by one of them. A program
that runs through on these arrays takes the same way through its code whatever the values are.
"""

import weakref
from collections.abc import Callable, Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from lare.latent.language.allowed import ATTRIBUTES, DOTTED, METHODS, SHAPING, SHAPING_METHODS, SIZES
from lare.latent.language.guards import only_numbers
from lare.latent.language.program import CALLED_TYPES, resolve


class Looked(Exception):
    """A value of a batch was asked for, where only the whole batch may be reckoned with."""


class Missing(Exception):
    """An entry was asked for that there is not. NumPy itself lets a slice end anywhere."""


WRITTEN: weakref.WeakValueDictionary[int, np.ndarray] = weakref.WeakValueDictionary()
"""Arrays of constants that values of the batch have been written into, by their identity."""


class Watched(np.ndarray):
    """An array of constants, as long as no values of the batch are written into its memory; then it is hidden too.

    A single number is one as well: NumPy's own scalars would make arrays that nobody watches, by `reshape` or `[None]`.
    """

    def __bool__(self) -> bool:
        refuse(self, "a decision depends on values of the batch: use np.where instead of if, and, or, max, min")
        return super().__bool__()

    def __int__(self) -> int:
        refuse(self, "a value of the batch is turned into one number: keep it an array")
        return super().__int__()

    def __float__(self) -> float:
        refuse(self, "a value of the batch is turned into one number: keep it an array, and use np instead of math")
        return super().__float__()

    def __index__(self) -> int:
        refuse(self, "a value of the batch is used as an index: use np.where or np.take_along_axis")
        return super().__index__()

    def __round__(self, digits: int | None = None) -> Any:
        return round(float(self), digits)  # as NumPy's scalars, which have it, and arrays do not

    def __hash__(self) -> int:  # type: ignore[override]
        refuse(self, "a value of the batch is used as a key: use np.where")
        return hash(self.item())

    def __getitem__(self, key: Any) -> Any:
        parts = key if isinstance(key, tuple) else (key,)
        by = [part for part in parts if touched([part])]
        if is_hidden(self):
            check_slices(key, self.shape)
        # x[np.arange(n), chosen] takes an entry of each row, as np.take_along_axis does. Not so a mask, which decides
        # how many there are, a number, which speaks for all rows, or rows that are chosen.
        if any(np.asarray(shown(part)).dtype == bool for part in by) or (
            is_hidden(self) and by and (touched(parts[:1]) or any(np.ndim(part) == 0 for part in by))
        ):
            raise Looked("an array is indexed by values of the batch: use np.where or np.take_along_axis")
        found = shown(self)[shown(key)]
        return hidden(found) if by or is_hidden(self) else watched(found)

    def __setitem__(self, key: Any, value: Any) -> None:
        shown(self)[shown(key)] = shown(value)
        if touched([key, value]):
            write(self)

    def __getattribute__(self, name: str) -> Any:
        if name in METHODS:
            return careful(getattr(self.view(np.ndarray), name), SHAPING_METHODS.get(name, ()), self)
        return super().__getattribute__(name)

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
        return careful(getattr(function, method))(*inputs, **keywords)


class Oblivious(Watched):
    """An array whose values cannot decide anything. Everything computed from it is one as well."""


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


def owner(array: np.ndarray) -> np.ndarray:
    """The array whose memory this one shows."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def identity(array: np.ndarray) -> int:
    """A number of the array whose memory this one shows. Not `id`, which is an audit event, and programs make none."""
    return object.__hash__(owner(array))


def write(array: np.ndarray) -> None:
    """Values of the batch have been written into an array: whoever sees its memory is hidden from now on."""
    WRITTEN[identity(array)] = owner(array)


def is_hidden(value: Any) -> bool:
    return isinstance(value, Oblivious) or (isinstance(value, np.ndarray) and identity(value) in WRITTEN)


def refuse(array: Watched, message: str) -> None:
    if is_hidden(array):
        raise Looked(message)


def hidden(value: Any) -> Any:
    """The same values, not to be looked into."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value).view(Oblivious)
    if isinstance(value, list | tuple):
        return type(value)(hidden(one) for one in value)
    return value


def watched(value: Any) -> Any:
    """The same constants, where it is noticed if something is written into them."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value).view(Watched)
    if isinstance(value, list | tuple):
        return type(value)(watched(one) for one in value)
    return value


def shown(value: Any) -> Any:
    """The same values as an ordinary array."""
    if isinstance(value, Watched):
        return value.view(np.ndarray)
    if isinstance(value, list | tuple):
        return type(value)(shown(one) for one in value)
    return value


def touched(values: Iterable[Any]) -> bool:
    """Whether one of some values, or of the values in them, is hidden."""
    return any(is_hidden(one) or (isinstance(one, list | tuple) and touched(one)) for one in values)


def careful(function: Callable[..., Any], shaping: tuple[int, ...] = (), *owners: Any) -> Callable[..., Any]:
    """A function whose result is hidden where one of its arguments, or its owner, is. NumPy itself may look.

    The arguments at the places `shaping` say what shape the result has, and must not be hidden.
    """

    def call(*arguments: Any, **keywords: Any) -> Any:
        sizes = [argument for place, argument in enumerate(arguments) if place in shaping]
        if touched([*sizes, *(keywords[key] for key in keywords.keys() & SIZES)]):
            raise Looked("the shape of an array depends on values of the batch: use np.where, which keeps every row")
        result = function(*shown(arguments), **{name: shown(value) for name, value in keywords.items()})
        if not touched([*owners, *arguments, *keywords.values()]):
            return watched(result)
        out = keywords.get("out", ())
        for one in out if isinstance(out, tuple) else (out,):
            write(one)
        return hidden(result)

    return call


TELLING = {"numpy.shape", "numpy.ndim", "numpy.size"}
"""Functions that tell nothing of values."""


def finfo(dtype: Any) -> SimpleNamespace:
    """`np.finfo`, whose numbers are watched."""
    told = np.finfo(dtype)
    return SimpleNamespace(
        **{name: watched(getattr(told, name)) for name in (*ATTRIBUTES, "max", "min") if hasattr(told, name)}
    )


def careful_functions() -> Mapping[str, Callable[..., Any]]:
    """The NumPy functions of the language, for `Program`: a result is hidden where an argument is. NumPy alone would lose that."""
    names = DOTTED.keys() - TELLING - CALLED_TYPES
    functions = {
        name: careful(only_numbers(resolve(name), name), SHAPING.get(name.removeprefix("numpy."), ()))
        for name in names
        if name.startswith("numpy.")
    }
    functions["numpy.finfo"] = finfo
    return functions | {f"{name}()": careful(resolve(name)) for name in CALLED_TYPES}
