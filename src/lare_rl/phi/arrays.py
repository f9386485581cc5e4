"""The arrays that a program works with: NumPy's shapes, views, indices and writing, on top of a graph of one row.

A program sees a batch: one axis of its arrays has a length that it does not know. In the graph this axis has length 1, or m
if the program has merged m numbers of a row into it: `x.reshape(batch * m, k)`. Other axes are the same. An operation that
would combine rows is refused: along the batch axis, with an index into it, or on arrays whose batch axes do not meet.

The numbers of a view are at `positions` of another array, its base. NumPy's own functions move positions (rearrange.py).
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NoReturn

import numpy as np

from lare_rl.phi.batch_axis import BATCH, BatchSize, Layout, common_batch_axis
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import NumberKind, all_positions, widest
from lare_rl.phi.indices import ALL, computed_positions, fixed_index, index_entries, is_mask, masked_index, overwrite
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.operand import Operand
from lare_rl.phi.rearrange import Source, leaves, map_leaves, move
from lare_rl.phi.values import describe

__all__ = [
    "Array", "Complex", "Masked", "as_array", "broadcast", "concatenate", "elementwise", "invert", "power", "rearrange",
    "refuse_complex", "stack",
]  # fmt: skip


class _ArrayLike(Operand):
    def apply(self, op: str, *operands: Any) -> Any:
        return {"power": power, "invert": invert}.get(op, partial(elementwise, op))(*operands)


class Array(_ArrayLike):
    """An array of a program: a node of the graph, or a view of another array, its base."""

    read_only = False  # True for the inputs

    def __init__(
        self,
        node: int,
        batch_axis: int | None,
        base: Array | None = None,
        positions: np.ndarray | None = None,
        two_rows: np.ndarray | None = None,
    ):
        self._node, self.batch_axis, self.positions, self._two_rows = node, batch_axis, positions, two_rows
        self.base = self if base is None else base

    @property
    def node(self) -> int:
        """Node of the numbers after all writing so far."""
        return self._node if self.positions is None else current_builder().gather(self.base.node, self.positions)

    @property
    def row_shape(self) -> tuple[int, ...]:
        """Shape in the graph."""
        return current_builder().nodes[self._node].shape if self.positions is None else self.positions.shape

    @property
    def layout(self) -> Layout:
        return Layout(self.row_shape, self.batch_axis)

    @property
    def shape(self) -> tuple[Any, ...]:
        return self.layout.shape

    @property
    def ndim(self) -> int:
        return len(self.row_shape)

    @property
    def kind(self) -> NumberKind:
        return current_builder().nodes[self.base._node].kind

    @property
    def is_row_number(self) -> bool:
        """Whether it is `np.arange(batch)`."""
        return current_builder().nodes[self._node].op == "row_number"

    @property
    def constant(self) -> np.ndarray | None:
        """The numbers, if they are the same in all rows; else, and for an array with a batch axis, None."""
        if self.batch_axis is not None:
            return None
        node = current_builder().nodes[self.node]
        return node.option if node.op == "constant" else None

    @property
    def is_number(self) -> bool:
        """Whether it is a number of NumPy: a constant without axes."""
        return not self.ndim and self.constant is not None

    @property
    def is_integer(self) -> bool:
        """Whether it is an integer of NumPy, which Python takes where it takes an int."""
        return self.is_number and self.kind == "int"

    def number(self) -> Any:
        """Return the number of Python that is the only entry of a constant."""
        values = self.constant
        if values is None:
            raise RefusedError(
                "E-FLOW", "a number or condition that differs from row to row: use np.where instead of if"
            )
        if values.size != 1:
            raise ValueError("the truth value of an array with more than one element is ambiguous")
        return values.item()

    def __bool__(self) -> bool:
        return bool(self.number())

    def __int__(self) -> int:
        return int(self.number())

    def __float__(self) -> float:
        return float(self.number())

    def __index__(self) -> int:
        return operator.index(self.number())

    def __iter__(self) -> Iterator[Any]:
        if self.batch_axis == 0:
            BATCH.refuse()
        if not self.ndim:
            raise TypeError("iteration over an array without axes")
        return iter([self[i] for i in range(self.row_shape[0])])

    # --- axes -----------------------------------------------------------------------------------------------------------

    def axis(self, axis: Any) -> int:
        """Return an axis counted from the front."""
        number = operator.index(axis)
        if not -self.ndim <= number < self.ndim:
            raise IndexError(f"axis {number} is out of bounds for an array of the shape {self.shape}")
        return number % self.ndim

    def row_axes(self, axis: Any) -> tuple[int, ...]:
        """Return the axes of an operation along `axis`, which is an int, a tuple, or None for all axes.

        Raises:
            RefusedError: the batch axis is among them.
        """
        numbers = range(self.ndim) if axis is None else axis if isinstance(axis, (tuple, list, range)) else [axis]
        axes = tuple(sorted(set(map(self.axis, numbers))))
        if self.batch_axis in axes:
            how = "without axis=" if axis is None else f"along axis {self.batch_axis}"
            text = f"{how}, the shape {self.shape} is computed over the batch: use axis=1 or axis=-1"
            raise RefusedError("E-ROWS", text)
        return axes

    @cached_property
    def source(self) -> Source:
        """The positions of its numbers in the base."""
        if self.positions is not None:
            return Source(self.positions, self.batch_axis, self._two_rows)
        source = Source(all_positions(self.row_shape), self.batch_axis)
        return source if self.batch_axis is None else source._replace(two_rows=source.labels(2, label_size(self)))

    def reshaped(self, row_shape: Sequence[int], batch_axis: int | None) -> Array:
        """Return the array in another shape of the graph, with its batch axis there."""
        return self.moved(Source(self.source.positions.reshape(row_shape), batch_axis))

    def moved(self, moved: Source) -> Array:
        """Return the numbers at these positions of the base. They are a view if NumPy made them as a view of `source`.

        Two rows tell, if there are any: in a single row, NumPy makes views that would be copies of several.
        """
        positions, batch_axis, two_rows = moved
        old = self.source
        shared = (positions, old.positions) if two_rows is None or old.two_rows is None else (two_rows, old.two_rows)
        if np.may_share_memory(*shared):
            return Array(self.base._node, batch_axis, self.base, positions, two_rows)
        return Array(current_builder().gather(self.base.node, positions), batch_axis)

    def __pos__(self) -> Array:
        return self.copy()

    def copy(self) -> Array:
        return Array(self.node, self.batch_axis)

    # --- indices --------------------------------------------------------------------------------------------------------

    def __getitem__(self, index: Any) -> Any:
        entries = self._entries(index)
        if entries and is_mask(entries[0]):
            return Masked(self[masked_index(self.layout, entries)].copy(), entries[0])
        if any(isinstance(entry, Array) for entry in entries):
            positions = computed_positions(self.layout, entries, as_array)
            return Array(current_builder().take(self.node, positions.node), positions.batch_axis)
        if self.batch_axis is not None and isinstance([e for e in entries if e is not None][self.batch_axis], int):
            shape = np.empty(self.row_shape)[tuple(0 if isinstance(entry, int) else entry for entry in entries)].shape
            return Array(current_builder().add("first_row", (), shape, self.kind), None)
        return self.moved(fixed_index(self.source, entries))

    def select(self, axis: int, index: Any) -> Any:
        """Return x[index] along an axis that is counted from the front."""
        return self[(*(ALL,) * axis, index)]

    def __setitem__(self, index: Any, value: Any) -> None:
        entries = self._entries(index)
        if entries and is_mask(entries[0]):
            region = self[index]
            if isinstance(value, Masked) and value.mask.node == region.mask.node:
                value = value.values
            elif isinstance(value, Array) and value.batch_axis is not None:
                raise ValueError("x[mask] = y, where y has rows: write x[mask] = y[mask], or np.where(mask, y, x)")
            mask = region.mask[(..., *(None,) * (region.values.ndim - region.mask.ndim))]
            self[masked_index(self.layout, entries)] = elementwise("where", mask, value, region.values)
        elif any(isinstance(entry, Array) for entry in entries):
            positions = computed_positions(self.layout, entries, as_array)
            if self.batch_axis is None and positions.batch_axis is not None:
                text = "x[i] = y, where i differs from row to row and x is the same for all rows: make x with the shape (batch, n)"
                raise RefusedError("E-ROWS", text)
            current_builder().check_size((math.prod(positions.row_shape), math.prod(self.row_shape)))
            values = broadcast(as_array(value), positions.shape)
            self[...] = Array(overwrite(self.node, positions.node, values.node), self.batch_axis)
        else:
            base, builder = self.base, current_builder()
            if base.read_only:
                raise ValueError("the inputs cannot be written into: copy them first, x = observation.copy()")
            positions, batch_axis, _ = fixed_index(self.source, entries)
            values = broadcast(as_array(value), Layout(positions.shape, batch_axis).shape)
            sources = all_positions(base.row_shape)
            sources.reshape(-1)[positions.reshape(-1)] = sources.size + np.arange(positions.size)
            base._node = builder.gather(builder.concat([base._node, builder.cast(values.node, base.kind)]), sources)

    def _entries(self, index: Any) -> list[Any]:
        items = index if isinstance(index, tuple) else (index,)
        return index_entries(self.layout, [as_array(x) if isinstance(x, (list, tuple, range)) else x for x in items])


def label_size(base: Array) -> int:
    """Return what the labels of a row's numbers are less than, for `Source.labels`. One label is left over, for zeros."""
    return math.prod(base.row_shape) + 1


class Masked(_ArrayLike):
    """x[mask], where rows differ in what the mask selects. It can be computed with, and written to the same places."""

    def __init__(self, values: Array, mask: Array):
        self.values, self.mask, self.kind = values, mask, values.kind


class Complex(_ArrayLike):
    """A complex array, as two real ones. `complex_numbers.py` says what can be done with it."""

    def __init__(self, real: Any, imag: Any):
        self.real, self.imag = real, imag

    def __getitem__(self, index: Any) -> Complex:
        return Complex(self.real[index], self.imag[index])


# --- arrays of values, and of other arrays ------------------------------------------------------------------------------


def as_array(value: Any) -> Array:
    """Convert an array, a number, or nested lists of numbers and arrays."""
    if isinstance(value, Array):
        return value
    if isinstance(value, (bool, int, float, np.ndarray, np.generic)):
        return Array(current_builder().constant(value), None)
    if isinstance(value, (list, tuple, range)):
        if not len(value):
            raise RefusedError("E-NUMPY", "an empty list has no numbers")
        current_builder().spend(len(value))
        if all(isinstance(item, (bool, int, float)) for item in value):
            return Array(current_builder().constant(list(value)), None)
        return stack([as_array(item) for item in value], 0)
    if isinstance(value, BatchSize):
        value.refuse()
    if isinstance(value, Masked):
        raise RefusedError("E-ROWS", "what x[mask] selects differs from row to row: use np.where(mask, x, 0)")
    if isinstance(value, (complex, Complex)):
        refuse_complex("a real array")
    raise TypeError(f"no array can be made of {describe(value)}")


def refuse_complex(what: str) -> NoReturn:
    raise RefusedError("E-NUMPY", f"{what} of complex numbers: use np.abs, np.angle, .real or .imag")


COMPLEX_OPERATIONS: dict[str, Callable[..., Any]] = {}
"""Functions of complex arrays. `complex_numbers.py` fills this table."""


def elementwise(op: str, *operands: Any) -> Any:
    """Apply an operation on each number to arrays, which are broadcast to each other."""
    if any(isinstance(operand, (complex, Complex)) for operand in operands):
        if op not in COMPLEX_OPERATIONS:
            refuse_complex(op)
        return COMPLEX_OPERATIONS[op](*operands)
    masks = {operand.mask.node: operand.mask for operand in operands if isinstance(operand, Masked)}
    if masks:
        if len(masks) > 1:
            raise RefusedError("E-ROWS", "x[mask] and y[other_mask] have different numbers of entries: use np.where")
        result = elementwise(op, *(value.values if isinstance(value, Masked) else value for value in operands))
        return Masked(result, *masks.values())
    arrays = [as_array(operand) for operand in operands]
    batch_axis = common_batch_axis([array.layout for array in arrays])
    builder, nodes = current_builder(), [array.node for array in arrays]
    return Array(builder.where(*nodes) if op == "where" else builder.elementwise(op, *nodes), batch_axis)


def power(x: Any, exponent: Any) -> Any:
    """Return x ** exponent. Small whole powers are products, and half a power is a square root."""
    value = exponent if isinstance(exponent, (int, float, Operand)) else as_array(exponent)
    if isinstance(value, Array) and value.is_number:
        value = value.number()
    if not isinstance(value, (int, float)) or value not in (0.5, 1, 2, 3, 4):
        return elementwise("power", x, exponent)
    if value == 0.5:
        return elementwise("sqrt", x)
    x = x if isinstance(x, Operand) else as_array(x)
    if isinstance(value, float) or getattr(x, "kind", None) == "bool":
        x = elementwise("multiply", x, 1.0 if isinstance(value, float) else 1)
    if value == 1:
        return +x  # a copy: a program may write into it
    square = elementwise("multiply", x, x)
    if value <= 2:
        return square
    return elementwise("multiply", square, x if value == 3 else square)


def invert(x: Any) -> Any:
    """Return ~x: not, of truth values; -x - 1, of integers."""
    if x.kind == "float":
        raise TypeError("~ of fractional numbers: it acts on conditions, as ~(x > 0)")
    return elementwise("logical_not", x) if x.kind == "bool" else elementwise("subtract", -1, x)


def rearrange(function: Callable[..., Any], arrays: Any, *args: Any) -> Any:
    """Return what a function of NumPy makes of arrays if it only moves, repeats and leaves out their numbers.

    Args:
        function: takes an array or nested lists of arrays, and `args`. The result is a view if NumPy returns a view.
        args: may have lengths of batch axes, and arrays whose numbers are constant.

    Raises:
        RefusedError: rows would be mixed, added or left out.
    """
    builder, inputs = current_builder(), leaves(arrays)
    sizes = [math.prod(array.row_shape) for array in inputs]
    builder.spend(builder.check_size([sum(sizes)]))
    if len(inputs) == 1:
        base = inputs[0].base
        nodes, sources, size = [base.node], [inputs[0].source], label_size(base)
    else:
        starts, size = itertools.accumulate(sizes, initial=0), sum(sizes) + 1
        nodes = [array.node for array in inputs]
        sources = [Source(all_positions(x.row_shape) + i, x.batch_axis) for x, i in zip(inputs, starts, strict=False)]
    remaining = iter(sources)
    moved = move(function, map_leaves(lambda _: next(remaining), arrays), args, size)

    def to_array(source: Source) -> Array:
        positions, batch_axis, _ = source
        has_zeros = positions.min() < 0
        if len(inputs) == 1 and not has_zeros:
            return inputs[0].moved(source)
        zeros = [builder.cast(builder.constant(0), widest([builder.nodes[i].kind for i in nodes]))] if has_zeros else []
        return Array(builder.gather(builder.concat([*nodes, *zeros]), positions % size), batch_axis)

    if isinstance(moved, Source):
        return to_array(moved)
    return (list if isinstance(moved, list) else tuple)(map(to_array, moved))


def broadcast(array: Array, shape: Sequence[Any]) -> Array:
    """Repeat an array to a shape that the program sees."""
    return rearrange(np.broadcast_to, array, tuple(shape))


def stack(arrays: Sequence[Array], axis: int) -> Array:
    return rearrange(np.stack, list(arrays), axis)


def concatenate(arrays: Sequence[Array], axis: int | None) -> Array:
    return rearrange(np.concatenate, list(arrays), axis)
