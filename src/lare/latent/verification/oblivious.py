"""Arrays that hide their values, to detect control flow that depends on values.

A latent function judges a whole batch at once; an `if` on a value would decide for all rows by one of them. If a program runs on
these arrays without an error, its operations do not depend on values.
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
    """The program read a value of the batch, but may only compute with whole arrays."""


class Missing(Exception):
    """The program read an entry that does not exist. NumPy itself accepts slices that end anywhere."""


WRITTEN: weakref.WeakValueDictionary[int, np.ndarray] = weakref.WeakValueDictionary()
"""Arrays of constants to which values of the batch have been written, by their `identity`."""


class Watched(np.ndarray):
    """An array of constants. It becomes hidden when values of the batch are written to its memory.

    Single numbers are such arrays too: `reshape` or `[None]` of NumPy's own scalars would make ordinary arrays.
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
        return round(float(self), digits)  # NumPy's scalars have this method, its arrays do not

    def __hash__(self) -> int:  # type: ignore[override]
        refuse(self, "a value of the batch is used as a key: use np.where")
        return hash(self.item())

    def __getitem__(self, key: Any) -> Any:
        parts = key if isinstance(key, tuple) else (key,)
        by = [part for part in parts if touched([part])]
        if is_hidden(self):
            check_slices(key, self.shape)
        # Allowed is x[np.arange(n), chosen], which takes one entry of each row, as np.take_along_axis does. Not allowed are
        # hidden masks, which decide the number of entries; hidden numbers, which decide for all rows; and hidden row indices.
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
    """A hidden array, whose values cannot decide anything. Everything that is computed from it is hidden too."""


def check_slices(key: Any, shape: tuple[int, ...]) -> None:
    """Slices of all axes except the rows must lie within the array. Beyond its end, they would silently be empty."""
    parts = key if isinstance(key, tuple) else (key,)
    for part, size in list(zip(parts, shape, strict=False))[1:]:
        if part is None or part is Ellipsis:
            return
        if isinstance(part, slice):
            for end in (part.start, part.stop):
                if isinstance(end, int) and not -size <= end <= size:
                    raise Missing(f"the slice {part.start}:{part.stop} reaches past the {size} entries that there are")


def owner(array: np.ndarray) -> np.ndarray:
    """The array that owns the memory of this one."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def identity(array: np.ndarray) -> int:
    """A number that identifies the owner of an array's memory. Not `id`: it is an audit event, and programs must cause none."""
    return object.__hash__(owner(array))


def write(array: np.ndarray) -> None:
    """Note that values of the batch were written to an array: all arrays on its memory are hidden from now on."""
    WRITTEN[identity(array)] = owner(array)


def is_hidden(value: Any) -> bool:
    return isinstance(value, Oblivious) or (isinstance(value, np.ndarray) and identity(value) in WRITTEN)


def refuse(array: Watched, message: str) -> None:
    if is_hidden(array):
        raise Looked(message)


def hidden(value: Any) -> Any:
    """The same values as hidden arrays."""
    if isinstance(value, np.ndarray | np.generic):
        return np.asarray(value).view(Oblivious)
    if isinstance(value, list | tuple):
        return type(value)(hidden(one) for one in value)
    return value


def watched(value: Any) -> Any:
    """The same constants as arrays that become hidden when values of the batch are written to them."""
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
    """Whether one of the values, or an entry of them, is hidden."""
    return any(is_hidden(one) or (isinstance(one, list | tuple) and touched(one)) for one in values)


def careful(function: Callable[..., Any], shaping: tuple[int, ...] = (), *owners: Any) -> Callable[..., Any]:
    """A function whose result is hidden if an argument or one of `owners` is. The NumPy function itself receives the values.

    The arguments at the positions `shaping` determine the shape of the result, and must not be hidden.
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
"""Functions whose results do not depend on values."""


def finfo(dtype: Any) -> SimpleNamespace:
    """`np.finfo`, whose numbers are watched."""
    told = np.finfo(dtype)
    return SimpleNamespace(
        **{name: watched(getattr(told, name)) for name in (*ATTRIBUTES, "max", "min") if hasattr(told, name)}
    )


def careful_functions() -> Mapping[str, Callable[..., Any]]:
    """The NumPy functions of the language, for `Program`: a result is hidden if an argument is. NumPy itself would lose this."""
    names = DOTTED.keys() - TELLING - CALLED_TYPES
    functions = {
        name: careful(only_numbers(resolve(name), name), SHAPING.get(name.removeprefix("numpy."), ()))
        for name in names
        if name.startswith("numpy.")
    }
    functions["numpy.finfo"] = finfo
    return functions | {f"{name}()": careful(resolve(name)) for name in CALLED_TYPES}
