"""Arrays that record, for each number, the row of the batch on which it depends. They prove that rows are independent.

The operations of a program do not depend on values (`oblivious`). Which numbers are combined in a batch therefore depends only on
its size, and one call on these arrays finds out. A number that depends on no row is a constant (`NONE`). The call raises `Mixed`
if two rows are combined, or if a constant reveals the position of a row. It raises `Unproved` if an operation is not known.
"""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from lare.latent.language.allowed import DOTTED
from lare.latent.language.program import CALLED_TYPES, resolve
from lare.latent.verification.oblivious import TELLING

NONE = -1

Rows = np.ndarray
"""The index of each number's row. Not a `jaxtyping` type, because `jaxtyping` imports `socket`, and this runs in the worker."""


class Mixed(Exception):
    """A number of one row is used for another row."""


class Unproved(Exception):
    """It cannot be determined which rows are combined. Other checks test it instead."""


class Rowed(np.ndarray):
    """An array whose `rows` hold, for each number, the row on which it depends. Views share the `rows`."""

    rows: Rows

    def looked_into(self) -> Any:
        if of_rows(self):
            raise Unproved("a value is looked into")
        return plain(self)

    def __bool__(self) -> bool:
        return bool(self.looked_into())

    def __int__(self) -> int:
        return int(self.looked_into())

    def __float__(self) -> float:
        return float(self.looked_into())

    def __index__(self) -> int:
        return self.looked_into().__index__()

    def __round__(self, digits: int | None = None) -> Any:
        return round(float(self), digits)

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(self.looked_into().item())

    def __getitem__(self, key: Any) -> Any:
        parts, rows = key if isinstance(key, tuple) else (key,), self.rows
        chosen = [place for place, part in enumerate(parts) if of_rows(part)]
        for place in chosen:  # the values may select any entry along this axis
            if any(part is None or part is Ellipsis or np.asarray(plain(part)).dtype == bool for part in parts):
                raise Unproved("an index by values, beside new axes or masks")
            rows = np.broadcast_to(reduced(rows, place, True), rows.shape)
        rows = rows[plain(key)]
        for place in chosen:
            own = rows_of(as_one(parts[place]))
            rows = joined([rows, own.reshape(own.shape + (1,) * (rows.ndim - own.ndim))], rows.shape)
        return made(plain(self)[plain(key)], rows)

    def __setitem__(self, key: Any, value: Any) -> None:
        if of_rows(list(key) if isinstance(key, tuple) else [key]):
            raise Unproved("a place is chosen by values")
        plain(self)[plain(key)] = plain(value)
        rows = rows_of(as_one(value))
        self.rows[plain(key)] = rows.reshape(rows.shape[max(0, rows.ndim - self.rows[plain(key)].ndim) :])

    def __getattribute__(self, name: str) -> Any:
        if name == "T":
            return FUNCTIONS["numpy.transpose"](self)
        if name == "astype":
            return lambda dtype, **keywords: made(
                plain(self).astype(plain(dtype)), self.rows.copy()
            )  # always a copy, whatever `copy` is
        if name in ("reshape", "transpose"):  # these also take sizes as separate arguments
            function = FUNCTIONS[f"numpy.{name}"]
            return lambda *sizes: function(self, *([sizes[0] if len(sizes) == 1 else sizes] if sizes else []))
        if name == "flatten":
            return lambda: FUNCTIONS["numpy.ravel"](FUNCTIONS["numpy.copy"](self))
        if f"numpy.{name}" in FUNCTIONS and callable(getattr(np.ndarray, name, None)):
            return lambda *arguments, **keywords: FUNCTIONS[f"numpy.{name}"](self, *arguments, **keywords)
        return super().__getattribute__(name)

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
        if method != "__call__":
            raise Unproved(f"np.{function.__name__}.{method}")
        return product(function)(*inputs) if function is np.matmul else by_element(function)(*inputs, **keywords)


# --- values and their rows -------------------------------------------------------------------------------------------


def labelled(array: np.ndarray) -> Rowed:
    """A batch, whose first axis is that of the rows, with its rows."""
    rows = np.arange(len(array)).reshape(-1, *(1,) * (array.ndim - 1))
    return made(array, np.broadcast_to(rows, array.shape).copy())


def made(value: Any, rows: Any) -> Any:
    """An array of values with the given rows."""
    if isinstance(value, list | tuple):
        return type(value)(made(one, of_one) for one, of_one in zip(value, rows, strict=True))
    array = np.asarray(value).view(Rowed)
    array.rows = np.asarray(rows)
    if array.rows.shape != array.shape:
        raise Unproved("the rows of an array have another shape")
    return array


def plain(value: Any) -> Any:
    """The same values as ordinary arrays."""
    if isinstance(value, Rowed):
        return value.view(np.ndarray)
    return type(value)(map(plain, value)) if isinstance(value, list | tuple) else value


def rows_of(value: Any) -> Any:
    """The rows of a value, in its shape; for a list, a list."""
    if isinstance(value, list | tuple):
        return type(value)(map(rows_of, value))
    return value.rows if isinstance(value, Rowed) else np.full(np.shape(value), NONE)


def of_rows(value: Any) -> bool:
    """Whether a value depends on any row."""
    if isinstance(value, list | tuple):
        return any(map(of_rows, value))
    return isinstance(value, Rowed) and bool((value.rows != NONE).any())


def as_one(value: Any) -> Any:
    """A list as an array."""
    return FUNCTIONS["numpy.array"](value) if isinstance(value, list | tuple) else value


def joined(parts: list[Any], shape: tuple[int, ...]) -> Rows:
    """The rows of a result that combines several arrays element by element."""
    rows = np.full(shape, NONE)
    for part in parts:
        other = np.broadcast_to(part, shape)
        if ((rows != NONE) & (other != NONE) & (rows != other)).any():
            raise Mixed("numbers of two rows meet")
        rows = np.asarray(np.maximum(rows, other))
    return rows


def reduced(rows: Rows, axis: Any, keepdims: bool = False) -> Rows:
    """The rows of a result that combines all numbers along some axes."""
    most = np.iinfo(rows.dtype).max
    least = np.where(rows == NONE, most, rows).min(axis=axis, keepdims=keepdims, initial=most)
    highest = rows.max(axis=axis, keepdims=keepdims, initial=NONE)
    if ((highest != NONE) & (least != highest)).any():
        raise Mixed("this goes over the batch")
    return np.asarray(highest)


def check_places(rows: Rows, parts: list[Any]) -> None:
    """Raise `Mixed` if a constant differs between rows: it would reveal the position in the batch."""
    for axis in range(rows.ndim):
        if (np.take(rows, [0], axis) == rows).all():
            continue
        for part in parts:
            if np.ndim(part) and not of_rows(part):
                values = np.broadcast_to(plain(part), rows.shape)
                if not np.array_equal(np.broadcast_to(np.take(values, [0], axis), rows.shape), values, equal_nan=True):
                    raise Mixed("a constant has another value for each row")


# --- kinds of functions ----------------------------------------------------------------------------------------------


def value_of(function: Callable[..., Any], arguments: Any, keywords: Mapping[str, Any]) -> Any:
    return function(*plain(arguments), **{name: plain(one) for name, one in keywords.items()})


def by_element(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that combines numbers at the same position."""

    def call(*arguments: Any, out: Any = None, **keywords: Any) -> Any:
        target = out[0] if isinstance(out, tuple) else out
        there = {} if target is None else {"out": plain(target)}
        value = value_of(function, arguments, {**keywords, **there})
        given = (*arguments, *keywords.values(), *([target] if there and "where" in keywords else []))
        parts = [one for some in given for one in (some if isinstance(some, list) else [some])]
        parts = [as_one(one) for one in parts if not isinstance(one, str | type) and one is not None]
        rows = joined([rows_of(one) for one in parts if np.ndim(one) <= np.ndim(value)], np.shape(value))
        check_places(rows, [one for one in parts if one is not target])
        if target is None:
            return made(value, rows)
        target.rows[...] = rows
        return target

    return call


def over_axes(function: Callable[..., Any], place: int = 1, usual: Any = None) -> Callable[..., Any]:
    """A function that combines all numbers along some axes. `axis` is a keyword, or the positional argument `place`."""

    def call(value: Any, *arguments: Any, **keywords: Any) -> Any:
        value = as_one(value)
        found = value_of(function, (value, *arguments), keywords)
        rows = rows_of(value)
        for one in (*arguments, *(keywords[name] for name in keywords.keys() - {"weights", "where"})):
            if of_rows(one):
                raise Unproved("an axis by values")
        for name in keywords.keys() & {"weights", "where"}:
            rows = joined([rows, rows_of(keywords[name])], rows.shape)
        axis = plain(keywords.get("axis", arguments[place - 1] if len(arguments) >= place else usual))
        return made(
            found, reduced(rows, tuple(axis) if isinstance(axis, list) else axis, bool(keywords.get("keepdims")))
        )

    return call


def of_first(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of each single number of the first argument."""

    def call(value: Any, *arguments: Any, **keywords: Any) -> Any:
        if of_rows([*arguments, *keywords.values()]):
            raise Unproved(f"np.{function.__name__} by values")
        value = as_one(value)
        return made(value_of(function, (value, *arguments), keywords), rows_of(value))

    return call


def along(function: Callable[..., Any], place: int, usual: Any = -1) -> Callable[..., Any]:
    """A function that combines numbers along one axis, and returns as many numbers or fewer."""

    def call(value: Any, *arguments: Any, **keywords: Any) -> Any:
        if of_rows([*arguments, *keywords.values()]):
            raise Unproved(f"np.{function.__name__} with more values")
        value = as_one(value)
        found = value_of(function, (value, *arguments), keywords)
        axis = plain(keywords.get("axis", arguments[place - 1] if len(arguments) >= place else usual))
        rows = reduced(rows_of(value), axis, axis is not None)
        return made(found, np.broadcast_to(rows, found.shape).copy())

    return call


def moving(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that moves numbers without combining them. Their rows are moved in the same way."""

    def call(value: Any, *arguments: Any, **keywords: Any) -> Any:
        if of_rows([*arguments, *keywords.values()]):
            raise Unproved("a place by values")
        found = value_of(function, (value, *arguments), keywords)
        keywords = {name: one for name, one in keywords.items() if name != "dtype"}
        return alike(value, found, value_of(function, (rows_of(value), *arguments), keywords))

    return call


def alike(value: Any, found: Any, rows: Any) -> Any:
    """A result with its rows. Both or neither must share memory with `value`, so that a later write changes both alike."""
    if isinstance(value, Rowed):
        for one, own in zip(found, rows, strict=True) if isinstance(found, list) else [(found, rows)]:
            if np.may_share_memory(one, plain(value)) != np.may_share_memory(own, value.rows):
                raise Unproved("an array and its rows lie in memory in other ways")
    return made(found, rows)


def product(function: Callable[..., Any]) -> Callable[..., Any]:
    """A product of matrices."""

    def call(left: Any, right: Any) -> Any:
        left, right = as_one(left), as_one(right)
        found = function(plain(left), plain(right))
        if np.ndim(left) == 0 or np.ndim(right) == 0:
            return by_element(np.multiply)(left, right)
        if function is np.dot and max(np.ndim(left), np.ndim(right)) > 2:
            raise Unproved("np.dot of more than two dimensions")
        first, second = reduced(rows_of(left), -1), reduced(rows_of(right), -2 if np.ndim(right) > 1 else -1)
        if np.ndim(left) > 1 and np.ndim(right) > 1:
            first, second = first[..., :, None], second[..., None, :]
        return made(found, joined([first, second], found.shape))

    return call


def einsum(pattern: str, *arguments: Any) -> Any:
    """`np.einsum`, where each letter is an axis. The axis of the rows must have one letter everywhere, also in the result."""
    found = np.einsum(pattern, *plain(arguments))
    given, arrow, result = pattern.replace(" ", "").partition("->")
    if not arrow or "." in pattern:
        raise Unproved("a pattern of np.einsum without ->")
    parts = []
    for letters, one in zip(given.split(","), arguments, strict=True):
        rows = rows_of(one)
        for axis in range(rows.ndim - 1, -1, -1):  # axes that are not in the result are summed over
            if letters[axis] not in result or letters.index(letters[axis]) != axis:
                rows = reduced(rows, axis)
        kept = [letter for place, letter in enumerate(letters) if letter in result and letters.index(letter) == place]
        order = sorted(range(len(kept)), key=lambda place: result.index(kept[place]))
        rows = rows.transpose(order)
        parts.append(rows.reshape([rows.shape[order.index(kept.index(one))] if one in kept else 1 for one in result]))
    return made(found, joined(parts, found.shape))


def array(value: Any, *arguments: Any, **keywords: Any) -> Any:
    """`np.array`, but always a copy, so that writes to it change no other array."""
    keywords = {name: one for name, one in keywords.items() if name != "copy"}
    found = value_of(np.array, (value, *arguments), keywords)
    return made(found, np.array(rows_of(value), np.int64, ndmin=keywords.get("ndmin", 0)))


def asarray(value: Any, *arguments: Any, **keywords: Any) -> Any:
    found = value_of(np.asarray, (value, *arguments), keywords)
    if isinstance(value, Rowed) and np.may_share_memory(found, plain(value)):
        return made(found, value.rows)
    return array(value, *arguments, **keywords)


def filled(function: Callable[..., Any], by: int | None = None) -> Callable[..., Any]:
    """A function that makes a new array. If `by` is given, the argument at `by` is the value that fills it."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        found = value_of(function, arguments, keywords)
        filling = keywords.get("fill_value", arguments[by] if by is not None and len(arguments) > by else 0)
        return made(found, joined([rows_of(filling)], found.shape))

    return call


def take_along_axis(value: Any, index: Any, axis: int = -1) -> Any:
    found = np.take_along_axis(plain(value), plain(index), axis)
    return made(found, joined([reduced(rows_of(value), axis, True), rows_of(index)], found.shape))


def other(name: str) -> Callable[..., Any]:
    """A function that is only known to return constants for constants."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        if of_rows([*arguments, *keywords.values()]):
            raise Unproved(name.replace("numpy", "np"))
        found = value_of(resolve(name), arguments, keywords)
        return made(found, rows_of(found))

    return call


def finfo(dtype: Any) -> SimpleNamespace:
    """`np.finfo`, whose numbers are constants."""
    told = np.finfo(dtype)
    numbers = {name: made(getattr(told, name), NONE) for name in ("eps", "max", "min", "resolution", "tiny")}
    return SimpleNamespace(dtype=told.dtype, **numbers)


KINDS: dict[str, Callable[[Callable[..., Any]], Callable[..., Any]]] = {
    **dict.fromkeys("clip where isclose select".split(), by_element),
    **dict.fromkeys("nan_to_num around round interp sinc".split(), of_first),
    **dict.fromkeys("sum prod mean max min amax amin all any nanmax nanmean nanmin nansum std var".split(), over_axes),
    **dict.fromkeys("median ptp average argmax argmin".split(), over_axes),
    **dict.fromkeys("percentile quantile linalg.norm".split(), lambda function: over_axes(function, 2)),
    **dict.fromkeys(
        [f"{name}.reduce" for name in "add multiply maximum minimum logical_and logical_or".split()],
        lambda function: over_axes(function, 1, 0),
    ),
    **dict.fromkeys("cumsum cumprod".split(), lambda function: along(function, 1, None)),
    "sort": lambda function: along(function, 1),
    "diff": lambda function: along(function, 2),
    **dict.fromkeys(
        "reshape transpose swapaxes moveaxis expand_dims squeeze broadcast_to column_stack dstack".split(), moving
    ),
    **dict.fromkeys("hstack vstack concatenate stack flip roll repeat tile take split ravel copy".split(), moving),
    **dict.fromkeys("atleast_1d atleast_2d".split(), moving),
    **dict.fromkeys("matmul dot".split(), product),
    **dict.fromkeys("zeros ones arange linspace eye identity zeros_like ones_like".split(), filled),
    **dict.fromkeys("full full_like".split(), lambda function: filled(function, 1)),
}
"""Which numbers each function combines."""


def row_functions() -> dict[str, Callable[..., Any]]:
    """The NumPy functions of the language on these arrays, for `Program`."""
    found: dict[str, Callable[..., Any]] = {}
    for name in DOTTED.keys() - TELLING - CALLED_TYPES:
        if name.startswith("numpy."):
            function, kind = resolve(name), KINDS.get(name.removeprefix("numpy."))
            if kind is None:
                found[name] = by_element(function) if isinstance(function, np.ufunc) else other(name)
            else:
                found[name] = kind(function)
    special = {"array": array, "asarray": asarray, "einsum": einsum, "take_along_axis": take_along_axis, "finfo": finfo}
    found |= {f"numpy.{name}": function for name, function in special.items()}
    return found | {f"{name}()": by_element(resolve(name)) for name in CALLED_TYPES}


FUNCTIONS = row_functions()


def check_own(values: Any, rows: int) -> None:
    """Raise `Mixed` if a factor (rows, 1) of a row depends on another row or on the position in the batch."""
    for number, value in enumerate(values, start=1):
        found = rows_of(value)
        if not ((found[:, 0] == np.arange(rows)) | (found[:, 0] == NONE)).all():
            raise Mixed(f"factor {number} of a row is that of another")
        if (found == NONE).any() and (of_rows(value) or (plain(value) != plain(value)[:1]).any()):
            raise Mixed(f"factor {number} has another value for each place in the batch")
