"""Spaces as rows of numbers: every observation and action becomes a row of float32, in Gymnasium's own order."""

import functools
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Shaped
from pydantic import Field

from lare_rl.errors import Checked, LareError, shortened

Kind = Literal["numbers", "choices", "named", "in a row"]


class Layout(Checked):
    """How the elements of a space become rows. It can be saved as JSON."""

    kind: Kind
    shape: tuple[int, ...] = ()
    """For `numbers`: the shape of one element."""
    choices: tuple[int, ...] = ()
    """For `choices`: the number of choices in each place. In a row, each place is a one-hot vector of that length."""
    first: tuple[int, ...] = ()
    """For `choices`: the number of the first choice, in each place."""
    names: tuple[str, ...] = ()
    """For `named`: the keys, in order."""
    parts: tuple["Layout", ...] = Field(default=())
    """For `named` and `in a row`: the spaces that it is made of."""

    @functools.cached_property
    def size(self) -> int:
        """Numbers in a row."""
        if self.kind == "numbers":
            return int(np.prod(self.shape, dtype=int))
        return sum(self.choices) if self.kind == "choices" else sum(part.size for part in self.parts)

    def rows(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """A batch of elements as rows. As in Gymnasium's vector environments, a batch of mappings is a mapping of batches.

        The batch may have several axes, of steps and of agents. Values that are rows already are not changed, except for a Box
        without an axis, where (n, 1) is read as n times 1 elements.

        Raises:
            LareError: the values are not elements of the space.
        """
        if self.kind == "named" and isinstance(values, dict):
            missing = [key for key in self.names if key not in values]
            if missing:
                raise LareError(f"{name} has no {missing[0]!r}: it needs {', '.join(map(repr, self.names))}")
            return self.joined([values[key] for key in self.names], name)
        if self.kind == "in a row" and isinstance(values, tuple | list) and len(values) == len(self.parts):
            return self.joined(values, name)
        array = array_of(values, name)
        if self.kind == "choices":
            return self.chosen(array, name)
        lead = array.shape[: array.ndim - len(self.shape)]
        if self.kind == "numbers" and array.shape == (*lead, *self.shape):
            return in_float32(array.reshape(*lead, self.size))
        return self.as_they_are(array, name)

    def joined(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """The rows of all parts, side by side."""
        labels = self.names or range(len(self.parts))
        parts = [
            part.rows(value, f"{name}[{label!r}]")
            for part, value, label in zip(self.parts, values, labels, strict=True)
        ]
        for part in parts:
            if part.shape[:-1] != parts[0].shape[:-1]:
                one, other = parts[0].shape[:-1], part.shape[:-1]
                raise LareError(
                    f"the parts of {name} have the shapes {one} and {other}: they are not of the same steps"
                )
        return np.concatenate(parts, axis=-1)

    def chosen(self, array: Shaped[np.ndarray, "*shape"], name: str) -> Float[np.ndarray, "*batch size"]:
        """Numbers of choices as rows, one-hot in each place."""
        single = not self.shape
        if single and array.ndim and array.shape[-1] == self.size and array.dtype.kind == "f":
            return in_float32(array)
        places = array[..., None] if single else array
        if places.shape[-1:] != (len(self.choices),):
            return self.as_they_are(array, name)
        with np.errstate(invalid="ignore"):  # NaN is refused below, like any other value that is not a choice
            numbers = places.astype(np.int64) - np.asarray(self.first)
        if np.any((numbers < 0) | (numbers >= np.asarray(self.choices)) | (numbers + np.asarray(self.first) != places)):
            raise LareError(f"{name} holds a choice that does not exist: {shortened(array)}")
        return np.concatenate(
            [np.eye(count, dtype=np.float32)[numbers[..., place]] for place, count in enumerate(self.choices)], axis=-1
        )

    def as_they_are(self, array: Shaped[np.ndarray, "*shape"], name: str) -> Float[np.ndarray, "*batch size"]:
        """Values that are rows already."""
        if array.ndim == 0 or array.shape[-1] != self.size:
            raise LareError(f"{name} must be rows of {self.size} numbers, and has the shape {array.shape}")
        return in_float32(array)


def array_of(values: Any, name: str) -> Shaped[np.ndarray, "*shape"]:
    """Numbers as an array. Raises `LareError` if the values are not numbers."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # unequal lengths; objects that do not convert
        array = np.empty(0, object)
    if array.dtype.kind not in "biuf":
        raise LareError(f"{name} must be numbers, and is {shortened(values)}")
    return array


def in_float32(array: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The same numbers in float32. Numbers that are too large become infinite, which the assigner refuses."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32, copy=False)


def numbers(size: int) -> Layout:
    """The layout of rows of `size` numbers."""
    return Layout(kind="numbers", shape=(size,))


def layout_of(space: "spaces.Space | int | Layout", name: str) -> Layout:
    """The layout of a Gymnasium space, or of rows of so many numbers.

    Raises:
        LareError: its elements have no fixed size.
    """
    match space:
        case Layout():
            return space
        case int():
            return numbers(space)
        case spaces.Box():
            return Layout(kind="numbers", shape=space.shape)
        case spaces.MultiBinary():
            return Layout(kind="numbers", shape=space.shape)
        case spaces.Discrete():
            return Layout(kind="choices", choices=(int(space.n),), first=(int(space.start),))
        case spaces.MultiDiscrete() if space.nvec.ndim == 1:
            first = tuple(int(one) for one in space.start)
            return Layout(kind="choices", shape=space.shape, choices=tuple(map(int, space.nvec)), first=first)
        case spaces.Dict():
            parts = tuple(layout_of(part, f"{name}[{key!r}]") for key, part in space.spaces.items())
            return Layout(kind="named", names=tuple(space.spaces), parts=parts)
        case spaces.Tuple():
            parts = tuple(layout_of(part, f"{name}[{place}]") for place, part in enumerate(space.spaces))
            return Layout(kind="in a row", parts=parts)
    raise LareError(f"{name} is {shortened(space)}, whose elements cannot be written as rows of numbers of one size")
