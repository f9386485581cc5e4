"""Spaces as rows of numbers: every observation and action becomes a row of float32, in Gymnasium's own order."""

import functools
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int, Shaped
from pydantic import AliasChoices, BeforeValidator, Field

from lare_rl.errors import CheckedModel, LareError, short_repr

__all__ = ["SpaceLayout", "check_numbers", "make_layout", "to_array"]

MAX_MAGNITUDE = 1e15
"""The largest absolute value of a number. In float32, the squares of 10^8 such numbers have a finite sum."""

_RENAMED_KINDS = {"in a row": "tuple", "named": "dict"}
"""From old to new kinds in files."""
Kind = Annotated[
    Literal["numbers", "choices", "dict", "tuple"], BeforeValidator(lambda kind: _RENAMED_KINDS.get(str(kind), kind))
]


class SpaceLayout(CheckedModel):
    """How the elements of a space become rows. It can be saved as JSON."""

    kind: Kind
    shape: tuple[int, ...] = ()
    """For `numbers`: the shape of one element. For `choices`: () for a single choice, (n,) for n of them."""
    choices: tuple[int, ...] = ()
    """For `choices`: the number of options of each choice, which is the length of its one-hot vector."""
    first: tuple[int, ...] = ()
    """For `choices`: the number of the first option, of each choice."""
    names: tuple[str, ...] = ()
    """For `dict`: the keys, in order."""
    inner: tuple["SpaceLayout", ...] = Field(default=(), validation_alias=AliasChoices("inner", "parts"))
    """For `dict` and `tuple`: the layouts of the spaces inside. Earlier versions saved them as `parts`."""

    @functools.cached_property
    def size(self) -> int:
        """The length of a row."""
        if self.kind == "numbers":
            return int(np.prod(self.shape, dtype=int))
        return sum(self.choices) if self.kind == "choices" else sum(space.size for space in self.inner)

    def rows(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """Return a batch of elements as rows. As in Gymnasium's vector environments, a batch of mappings is a mapping of batches.

        The batch may have several axes, of steps and of agents. Values that are rows already are not changed, except for a Box
        without an axis, where (n, 1) is read as n times 1 elements.

        Raises:
            LareError: the values are not elements of the space.
        """
        if self.kind == "dict" and isinstance(values, dict):
            missing = [key for key in self.names if key not in values]
            if missing:
                raise LareError(f"{name} has no {missing[0]!r}: it needs {', '.join(map(repr, self.names))}")
            return self._concatenate([values[key] for key in self.names], name)
        if self.kind == "tuple" and isinstance(values, tuple | list) and len(values) == len(self.inner):
            return self._concatenate(values, name)
        array = to_array(values, name)
        if self.kind == "choices":
            return self._one_hot(array, name)
        lead = array.shape[: array.ndim - len(self.shape)]
        if self.kind == "numbers" and lead and array.shape == (*lead, *self.shape):
            return _to_float32(array.reshape(*lead, self.size))
        return self._check_rows(array, name)

    def _concatenate(self, values: Any, name: str) -> Float[np.ndarray, "*batch size"]:
        """Return the rows of all inner spaces, side by side."""
        labels = self.names or range(len(self.inner))
        arrays = [
            space.rows(value, f"{name}[{label!r}]")
            for space, value, label in zip(self.inner, values, labels, strict=True)
        ]
        shapes = {array.shape[:-1] for array in arrays}
        if len(shapes) > 1:
            raise LareError(f"the entries of {name} have the shapes {sorted(shapes)}: give as many steps of each")
        return np.concatenate(arrays, axis=-1)

    def _one_hot(self, array: Shaped[np.ndarray, "*shape"], name: str) -> Float[np.ndarray, "*batch size"]:
        is_single = not self.shape
        if is_single and array.ndim and array.shape[-1] == self.size and array.dtype.kind == "f":
            return _to_float32(array)
        choices = array[..., None] if is_single else array
        if choices.shape[-1:] != (len(self.choices),):
            return self._check_rows(array, name)
        first, n_choices = np.asarray(self.first), np.asarray(self.choices)
        with np.errstate(invalid="ignore"):  # NaN is refused below, like any other value that is not a choice
            index = choices.astype(np.int64) - first
        if np.any((index < 0) | (index >= n_choices) | (index + first != choices)):
            raise LareError(f"{name} has a choice that does not exist: {short_repr(array)}")
        one_hot = [np.eye(n, dtype=np.float32)[index[..., i]] for i, n in enumerate(self.choices)]
        return np.concatenate(one_hot, axis=-1)

    def _check_rows(self, array: Shaped[np.ndarray, "*shape"], name: str) -> Float[np.ndarray, "*batch size"]:
        """Return values that are rows already."""
        if array.ndim == 0 or array.shape[-1] != self.size:
            hint = ""
            if name == "action" and array.dtype.kind in "iu" and self.kind == "numbers":
                hint = ", or for one of N choices, make the assigner with action_space=gymnasium.spaces.Discrete(N)"
            raise LareError(f"{name} has the shape {array.shape}: give rows of {self.size} numbers{hint}")
        return _to_float32(array)


def to_array(values: Any, name: str) -> Shaped[np.ndarray, "*shape"]:
    """Return numbers as an array. Raises `LareError` if the values are not numbers."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # unequal lengths; objects that do not convert
        array = np.empty(0, object)
    if array.dtype.kind not in "biuf":
        raise LareError(f"{name} is {short_repr(values)}: give numbers")
    return array


def check_numbers(array: Shaped[np.ndarray, "*shape"], name: str, rows: Int[np.ndarray, " rows"] | None = None) -> None:
    """Raise `LareError` for the first number that is not finite, or too large. `rows` are the numbers of the rows in the message."""
    with np.errstate(all="ignore"):
        is_wrong = ~(np.abs(array.astype(np.float64)) <= MAX_MAGNITUDE)  # true for NaN
    if is_wrong.any():
        index = np.argwhere(is_wrong)[0].tolist()
        value, labels = array[tuple(index)], index if rows is None else [int(rows[index[0]]), *index[1:]]
        entry = str(labels) if labels else ""
        raise LareError(f"{name}{entry} is {value}: give finite numbers, at most {MAX_MAGNITUDE:g}")


def _to_float32(array: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the numbers in float32. Numbers that are too large become infinite, which the assigner refuses."""
    with np.errstate(over="ignore"):
        return array.astype(np.float32, copy=False)


def make_layout(space: "spaces.Space | int | np.integer | SpaceLayout", name: str) -> SpaceLayout:
    """Return the layout of a Gymnasium space, or of rows of this many numbers.

    Raises:
        LareError: it is another space, or no space.
    """
    match space:
        case SpaceLayout():
            return space
        case int() | np.integer() if space >= 0:
            return SpaceLayout(kind="numbers", shape=(int(space),))
        case spaces.Box() | spaces.MultiBinary():
            return SpaceLayout(kind="numbers", shape=space.shape)
        case spaces.Discrete():
            return SpaceLayout(kind="choices", choices=(int(space.n),), first=(int(space.start),))
        case spaces.MultiDiscrete() if space.nvec.ndim == 1:
            first = tuple(map(int, space.start))
            return SpaceLayout(kind="choices", shape=space.shape, choices=tuple(map(int, space.nvec)), first=first)
        case spaces.Dict() if space.spaces and all(isinstance(key, str) for key in space.spaces):
            inner = tuple(make_layout(value, f"{name}[{key!r}]") for key, value in space.spaces.items())
            return SpaceLayout(kind="dict", names=tuple(space.spaces), inner=inner)
        case spaces.Tuple() if space.spaces:
            inner = tuple(make_layout(value, f"{name}[{i}]") for i, value in enumerate(space.spaces))
            return SpaceLayout(kind="tuple", inner=inner)
    raise LareError(
        f"{name} is {short_repr(space)}: give the number of entries, or a Gymnasium space: Box, Discrete, MultiBinary, MultiDiscrete with "
        "one axis, or a Dict (whose keys are texts) or Tuple of these that is not empty"
    )
