"""NumPy's functions on rows of a graph: the functions that `phi` may call, as operations of ONNX.

A value is a constant (a number, or an array), or `Rows`: an array whose first axis is the batch. No function here combines
rows of the batch; a call that would raises `Untranslatable`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lare.deploy.graph import Graph

LARGEST = 1 << 20
"""The largest number of entries of a constant."""


class Untranslatable(Exception):
    """The source has code that cannot be translated."""


@dataclass(frozen=True)
class Rows:
    """An array of a graph, by the name of its result."""

    graph: Graph
    name: str
    shape: tuple[int, ...]
    """Without the batch."""
    kind: str = "float32"
    """`float32`, `bool` or `int64`."""

    def made(
        self, operation: str, *arguments: object, shape: tuple[int, ...] | None = None, kind: str = "float32"
    ) -> "Rows":
        """The result of an operation."""
        return Rows(self.graph, self.graph.apply(operation, *arguments), self.shape if shape is None else shape, kind)

    def as_numbers(self) -> "Rows":
        """The same values in float32."""
        return self if self.kind == "float32" else self.made("Cast", self.name)


def is_rows(value: Any) -> bool:
    return isinstance(value, Rows)


def constant(value: Any) -> np.ndarray:
    """A number or an array of the program, as an array of float32 or bool."""
    found = np.asarray(value)
    if found.dtype.kind not in "biuf" or found.size > LARGEST:
        raise Untranslatable(f"a constant of type {found.dtype}, of {found.size} numbers")
    return found if found.dtype.kind == "b" else found.astype(np.float32)


def together(operation: str, *values: Any, kind: str = "float32", of: str = "float32") -> Rows:
    """An elementwise operation, with NumPy's broadcasting."""
    one = next(value for value in values if is_rows(value))
    ranks = {len(value.shape) for value in values if is_rows(value)}
    if len(ranks) > 1:
        raise Untranslatable("arrays with different numbers of axes")
    (rank,), shapes, arguments = ranks, [], []
    for value in values:
        if is_rows(value):
            value = value.as_numbers() if of == "float32" else value
            if value.kind != of:
                raise Untranslatable(f"{operation} of {value.kind}")
            shapes.append(value.shape)
            arguments.append(value.name)
        else:
            array = constant(value)
            if array.ndim > rank + 1 or (array.ndim == rank + 1 and array.shape[0] != 1):
                raise Untranslatable("a constant with a batch of its own")
            shapes.append(array.shape[1:] if array.ndim == rank + 1 else array.shape)
            arguments.append(array.astype(np.float32 if of == "float32" else bool))
    try:
        shape = np.broadcast_shapes((1,) * rank, *shapes)
    except ValueError as error:
        raise Untranslatable(str(error)) from error
    return one.made(operation, *arguments, shape=shape, kind=kind)


def axes_of(x: Rows, axis: Any) -> list[int]:
    """The axes of a reduction; the batch is axis 0."""
    given = [axis] if isinstance(axis, int) else list(axis) if isinstance(axis, tuple) else None
    if given is None:
        raise Untranslatable("a reduction over all axes")
    found = [one % (len(x.shape) + 1) for one in given]
    if 0 in found:
        raise Untranslatable("a reduction over the batch")
    return found


def squeezed(x: Rows, axes: Sequence[int]) -> Rows:
    """Remove axes of length 1; the batch is axis 0."""
    shape = tuple(size for place, size in enumerate(x.shape, start=1) if place not in axes)
    return x.made("Squeeze", x.name, np.array(axes, np.int64), shape=shape, kind=x.kind)


def reduction(operation: str, kind: str = "float32") -> Callable[..., Rows]:
    """A function such as `numpy.sum`."""

    def reduce(x: Rows, axis: Any = None, keepdims: bool = False) -> Rows:
        axes, x = axes_of(x, axis), x.as_numbers()
        shape = tuple(1 if place in axes else size for place, size in enumerate(x.shape, start=1))
        found = x.made(operation, x.name, np.array(axes, np.int64), shape=shape)
        found = found if keepdims else squeezed(found, axes)
        return together("Greater", found, 0.5, kind="bool") if kind == "bool" else found

    return reduce


def norm(x: Rows, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Rows:  # noqa: A002 - NumPy's name
    """`numpy.linalg.norm`, of vectors."""
    if ord not in (None, 2):
        raise Untranslatable(f"the norm of order {ord}")
    return together("Sqrt", reduction("ReduceSum")(together("Mul", x, x), axis, keepdims))


def matmul(x: Any, table: Any) -> Rows:
    """`numpy.matmul` of vectors, one in each row, and a constant vector or matrix."""
    array = None if is_rows(table) else constant(table).astype(np.float32)
    if not is_rows(x) or array is None:
        raise Untranslatable("a product (@) whose second part is computed from the batch")
    if len(x.shape) != 1 or array.ndim not in (1, 2) or len(array) != x.shape[0]:
        raise Untranslatable("a product (@) that is not of a row and a table")
    return x.made("MatMul", x.as_numbers().name, array, shape=array.shape[1:])


def position(operation: str) -> Callable[..., Rows]:
    """`numpy.argmax` or `argmin`."""

    def place(x: Rows, axis: Any = None) -> Rows:
        (one,), x = axes_of(x, axis), x.as_numbers()
        shape = (*x.shape[: one - 1], *x.shape[one:])
        return Rows(x.graph, x.graph.apply(operation, x.name, axis=one), shape, "int64")

    return place


def clip(x: Any, a_min: Any = None, a_max: Any = None) -> Any:
    """`numpy.clip`."""
    x = x if a_min is None else together("Max", x, a_min)
    return x if a_max is None else together("Min", x, a_max)


def rounded(x: Rows, decimals: int = 0) -> Rows:
    """`numpy.round`: to the nearest number with so many decimals, and from the middle to the even one."""
    size = 10.0**decimals
    return together("Div", together("Round", together("Mul", x, size)), size)


def where(condition: Rows, yes: Any, no: Any) -> Rows:
    """`numpy.where`. A constant among the values is first given the axes of the condition."""
    if not is_rows(condition) or condition.kind != "bool":
        raise Untranslatable("a condition that is not made of comparisons")
    zero = together("Mul", condition, 0.0)
    yes, no = (
        together("Add", zero if not is_rows(value) else value, 0.0 if is_rows(value) else value) for value in (yes, no)
    )
    shape = np.broadcast_shapes(condition.shape, yes.shape, no.shape)
    return condition.made("Where", condition.name, yes.name, no.name, shape=shape)


def reshaped(x: Rows, *sizes: Any) -> Rows:
    """`numpy.reshape`; the batch stays the first axis."""
    wanted = list(sizes[0] if len(sizes) == 1 and isinstance(sizes[0], tuple) else sizes)
    if not wanted or not (wanted[0] is BATCH or wanted[0] == -1) or wanted[1:].count(-1) + (wanted[0] == -1) > 1:
        raise Untranslatable("a reshape of the batch")
    rest, total = wanted[1:], int(np.prod(x.shape))
    known = int(np.prod([size for size in rest if size != -1]))
    if not all(isinstance(size, int) for size in rest) or known == 0 or total % known:
        raise Untranslatable("a reshape to sizes that are not known")
    shape = tuple(total // known if size == -1 else size for size in rest)
    if int(np.prod(shape)) != total:
        raise Untranslatable("a reshape of the batch")
    return x.made("Reshape", x.name, np.array([-1, *shape], np.int64), shape=shape, kind=x.kind)


def joined(parts: Sequence[Any], axis: int = 0) -> Rows:
    """`numpy.concatenate`."""
    if not all(is_rows(part) for part in parts):
        raise Untranslatable("a concatenation with a constant")
    (one,), parts = axes_of(parts[0], axis), [part.as_numbers() for part in parts]
    if len({(*part.shape[: one - 1], *part.shape[one:]) for part in parts}) > 1:
        raise Untranslatable("a concatenation of different shapes")
    first = parts[0]
    shape = (*first.shape[: one - 1], sum(part.shape[one - 1] for part in parts), *first.shape[one:])
    return Rows(first.graph, first.graph.apply("Concat", *(part.name for part in parts), axis=one), shape)


def stacked(parts: Sequence[Any], axis: int = 0) -> Rows:
    """`numpy.stack`."""
    if not all(is_rows(part) for part in parts):
        raise Untranslatable("a stack with a constant")
    place = axis % (len(parts[0].shape) + 2)
    if place == 0:
        raise Untranslatable("a stack along the batch")
    return joined([unsqueezed(part, place) for part in parts], axis=place)


def unsqueezed(x: Rows, axis: int) -> Rows:
    """Insert an axis of length 1; the batch is axis 0."""
    shape = (*x.shape[: axis - 1], 1, *x.shape[axis - 1 :])
    return x.made("Unsqueeze", x.name, np.array([axis], np.int64), shape=shape, kind=x.kind)


def indexed(x: Rows, index: tuple[Any, ...]) -> Rows:
    """x[:, ...] with whole numbers, slices and new axes."""
    if not index or index[0] != slice(None):
        raise Untranslatable("an index along the batch")
    axis, drop, add = 1, [], []
    for one in index[1:]:
        if one is None:
            add.append(axis + len(add) - len(drop))
            continue
        if axis > len(x.shape):
            raise Untranslatable("more indices than axes")
        size = x.shape[axis - 1]
        if isinstance(one, int):
            if not -size <= one < size:
                raise Untranslatable("an index beyond the end")
            start, stop, step = one % size, one % size + 1, 1
            drop.append(axis)
        elif isinstance(one, slice):
            start, stop, step = one.indices(size)
            if step < 1:
                raise Untranslatable("a slice backwards")
        else:
            raise Untranslatable("an index that is neither a number nor a slice")
        if (start, stop, step) != (0, size, 1):
            ends = (np.array([number], np.int64) for number in (start, stop, axis, step))
            shape = (*x.shape[: axis - 1], len(range(start, stop, step)), *x.shape[axis:])
            x = x.made("Slice", x.name, *ends, shape=shape, kind=x.kind)
        axis += 1
    x = squeezed(x, drop) if drop else x
    for place in add:
        x = unsqueezed(x, place)
    return x


class Batch:
    """The number of rows, `observation.shape[0]`, which the graph does not know."""


BATCH = Batch()


def elementwise(operation: str, **more: Any) -> Callable[..., Rows]:
    return lambda *values: together(operation, *values, **more)


def filled(value: float) -> Callable[[Rows], Rows]:
    """`numpy.zeros_like` or `ones_like`."""
    return lambda x: together("Add", together("Mul", x, 0.0), value)


def passed(x: Any, *_: Any, **__: Any) -> Any:
    """`numpy.asarray`, of an array."""
    return x.as_numbers() if is_rows(x) else np.asarray(x, np.float64)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{
        name: elementwise(operation)
        for name, operation in {
            "abs": "Abs",
            "absolute": "Abs",
            "sqrt": "Sqrt",
            "exp": "Exp",
            "log": "Log",
            "tanh": "Tanh",
            "cos": "Cos",
            "sin": "Sin",
            "sign": "Sign",
            "floor": "Floor",
            "ceil": "Ceil",
            "rint": "Round",
            "maximum": "Max",
            "minimum": "Min",
            "power": "Pow",
            "add": "Add",
            "subtract": "Sub",
            "multiply": "Mul",
            "divide": "Div",
            "negative": "Neg",
            "reciprocal": "Reciprocal",
        }.items()
    },
    **{
        name: elementwise(operation, kind="bool")
        for name, operation in {
            "less": "Less",
            "greater": "Greater",
            "less_equal": "LessOrEqual",
            "greater_equal": "GreaterOrEqual",
            "equal": "Equal",
        }.items()
    },
    "logical_and": elementwise("And", kind="bool", of="bool"),
    "logical_or": elementwise("Or", kind="bool", of="bool"),
    "logical_not": elementwise("Not", kind="bool", of="bool"),
    "round": rounded,
    "around": rounded,
    "square": lambda x: together("Mul", x, x),
    "log1p": lambda x: together("Log", together("Add", x, 1.0)),
    "expm1": lambda x: together("Sub", together("Exp", x), 1.0),
    "sum": reduction("ReduceSum"),
    "mean": reduction("ReduceMean"),
    "max": reduction("ReduceMax"),
    "amax": reduction("ReduceMax"),
    "min": reduction("ReduceMin"),
    "amin": reduction("ReduceMin"),
    "prod": reduction("ReduceProd"),
    "any": reduction("ReduceMax", "bool"),
    "all": reduction("ReduceMin", "bool"),
    "linalg.norm": norm,
    "matmul": matmul,
    "dot": matmul,
    "argmax": position("ArgMax"),
    "argmin": position("ArgMin"),
    "clip": clip,
    "where": where,
    "reshape": reshaped,
    "concatenate": joined,
    "stack": stacked,
    "zeros_like": filled(0.0),
    "ones_like": filled(1.0),
    "asarray": passed,
    "array": passed,
}
"""By NumPy's names. Functions that are methods too take the same arguments as methods."""
METHODS = frozenset("sum mean max min prod any all argmax argmin clip reshape round".split())
