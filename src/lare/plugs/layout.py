"""How a space lies in rows of numbers: every observation and action becomes a row of float32, in Gymnasium's own order."""

import functools
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Shaped
from pydantic import Field

from lare.errors import Checked, LareError, shortened

Kind = Literal["numbers", "choices", "named", "in a row"]


class Layout(Checked):
    """A space, as far as its rows are concerned. As JSON it can be kept."""

    kind: Kind
    shape: tuple[int, ...] = ()
    """numbers: of one element."""
    choices: tuple[int, ...] = ()
    """choices: how many there are, in each place; a row has a single 1 among as many numbers."""
    first: tuple[int, ...] = ()
    """choices: the number of the first one, in each place."""
    names: tuple[str, ...] = ()
    """named: the keys, in order."""
    parts: tuple["Layout", ...] = Field(default=())
    """named, in a row: the spaces that it is made of."""

    @functools.cached_property
    def size(self) -> int:
        """Numbers in a row."""
        if self.kind == "numbers":
            return int(np.prod(self.shape, dtype=int))
        return sum(self.choices) if self.kind == "choices" else sum(part.size for part in self.parts)

    def rows(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """A batch of elements as rows; as Gymnasium's vector environments have batches, a mapping of batches for a mapping.

        The batch may have several axes, of steps and of agents. Rows that are made already are taken as they are.

        Raises:
            LareError: they are no elements of the space.
        """
        if self.kind == "named":
            missing = [key for key in self.names if key not in values] if isinstance(values, dict) else ["a dict"]
            if missing:
                raise LareError(f"{name} has no {missing[0]}: it needs {', '.join(self.names)}")
            return self.joined([values[key] for key in self.names], name)
        if self.kind == "in a row" and isinstance(values, tuple | list) and len(values) == len(self.parts):
            return self.joined(values, name)
        array = np.asarray(values)
        if array.dtype.kind not in "biuf":
            raise LareError(f"{name} must be numbers, and is {shortened(values)}")
        if self.kind == "choices":
            return self.chosen(array, name)
        sizes = array.shape[len(array.shape) - len(self.shape) :]
        if sizes == self.shape:
            return array.reshape(*array.shape[: array.ndim - len(sizes)], self.size).astype(np.float32, copy=False)
        return self.as_they_are(array, name)

    def joined(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """The rows of all parts, side by side."""
        labels = self.names or range(len(self.parts))
        parts = [
            part.rows(value, f"{name}[{label!r}]")
            for part, value, label in zip(self.parts, values, labels, strict=True)
        ]
        return np.concatenate(parts, axis=-1)

    def chosen(self, array: Shaped[np.ndarray, "..."], name: str) -> Float[np.ndarray, "*batch size"]:
        """Numbers of choices as rows with a single 1 for each place."""
        single = not self.shape
        if single and array.ndim and array.shape[-1] == self.size and array.dtype.kind == "f":
            return array.astype(np.float32, copy=False)
        places = array[..., None] if single else array
        if places.shape[-1:] != (len(self.choices),):
            return self.as_they_are(array, name)
        numbers = places.astype(np.int64) - np.asarray(self.first)
        if np.any((numbers < 0) | (numbers >= np.asarray(self.choices)) | (numbers + np.asarray(self.first) != places)):
            raise LareError(f"{name} holds a choice that there is not: {shortened(array)}")
        return np.concatenate(
            [np.eye(count, dtype=np.float32)[numbers[..., place]] for place, count in enumerate(self.choices)], axis=-1
        )

    def as_they_are(self, array: Shaped[np.ndarray, "..."], name: str) -> Float[np.ndarray, "*batch size"]:
        """Rows that are made already."""
        if array.ndim == 0 or array.shape[-1] != self.size:
            raise LareError(f"{name} must be rows of {self.size} numbers, and has the shape {array.shape}")
        return array.astype(np.float32, copy=False)


def numbers(size: int) -> Layout:
    """Rows of numbers."""
    return Layout(kind="numbers", shape=(size,))


def layout_of(space: "spaces.Space | int | Layout", name: str) -> Layout:
    """Of a Gymnasium space, or of rows of so many numbers.

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
    raise LareError(f"{name} is {shortened(space)}, whose elements are no rows of numbers of one size")
