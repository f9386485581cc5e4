"""The arrays that a program works with: NumPy's shapes, views, indices and writing, on top of a graph of one row.

A program sees a batch: one axis of its arrays has a length that it does not know. In the graph this axis has length 1, or m if the
program has merged m numbers of a row into it: `x.reshape(batch * m, k)`. All other axes are the same in program and graph.
Whatever would combine rows is refused: an operation along the batch axis, an index into it, arrays whose batch axes do not meet.

The numbers of a view are at `positions` of another array, its base. NumPy itself is applied to positions, to find out where slices,
transposes, flips or repetitions take their numbers from, and whether the result is a view.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Never

import numpy as np

from lare_rl.phi.graph import Kind, Refused, all_positions, current_builder, widest

ALL = slice(None)


class BatchSize:
    """The length of a batch axis: the number of rows, times the numbers that a row has there. It is never 0."""

    def __init__(self, factor: int = 1):
        self.factor = factor

    def __repr__(self) -> str:
        return "batch" if self.factor == 1 else f"{self.factor} * batch"

    def __eq__(self, other: object) -> bool:
        if isinstance(other, BatchSize) and self.factor == other.factor:
            return True
        return other != 0 and self.refuse()

    def __gt__(self, other: object) -> bool:
        return other == 0 or self.refuse()

    def __ge__(self, other: object) -> bool:
        return other in (0, 1) or self.refuse()

    def __lt__(self, other: object) -> bool:
        return other not in (0, 1) and self.refuse()

    def __mul__(self, other: Any) -> BatchSize:
        factor = self.factor * operator.index(other)
        return BatchSize(factor) if factor > 0 else self.refuse()

    def __floordiv__(self, other: Any) -> BatchSize:
        factor, rest = divmod(self.factor, operator.index(other))
        return BatchSize(factor) if factor > 0 and not rest else self.refuse()

    def refuse(self, *_: Any) -> Never:
        raise Refused(
            "E-ROWS",
            "a factor cannot depend on the number of rows, and no loop can go over them: compute with columns, x[:, i]",
        )

    def __hash__(self) -> int:
        return hash(self.factor)

    __rmul__ = __mul__
    __le__ = __bool__ = __index__ = __int__ = __float__ = __neg__ = __abs__ = __round__ = refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __truediv__ = __rtruediv__ = __rfloordiv__ = refuse
    __mod__ = __rmod__ = __pow__ = __rpow__ = __divmod__ = refuse


BATCH = BatchSize()


def _binary(op: str) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]:
    """An operator, with the operand on the left and on the right."""
    return lambda self, other: elementwise(op, self, other), lambda self, other: elementwise(op, other, self)


class Operand:
    """What Python's operators act on, as on NumPy's arrays."""

    __array_ufunc__ = None
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        return "<array>"

    def __bool__(self) -> bool:
        raise Refused("E-FLOW", "a condition that differs from row to row: use np.where instead of if")

    __add__, __radd__ = _binary("add")
    __sub__, __rsub__ = _binary("subtract")
    __mul__, __rmul__ = _binary("multiply")
    __truediv__, __rtruediv__ = _binary("divide")
    __floordiv__, __rfloordiv__ = _binary("floor_divide")
    __mod__, __rmod__ = _binary("remainder")
    __and__, __rand__ = _binary("bitwise_and")
    __or__, __ror__ = _binary("bitwise_or")
    __xor__, __rxor__ = _binary("bitwise_xor")
    __lshift__, __rlshift__ = _binary("left_shift")
    __rshift__, __rrshift__ = _binary("right_shift")
    __lt__, __gt__ = _binary("less")
    __le__, __ge__ = _binary("less_equal")
    __eq__, __ne__ = _binary("equal")[0], _binary("not_equal")[0]

    def __pow__(self, exponent: Any) -> Any:
        return power(self, exponent)

    def __rpow__(self, base: Any) -> Any:
        return power(base, self)

    def __neg__(self) -> Any:
        return elementwise("negative", self)

    def __pos__(self) -> Any:
        return self

    def __abs__(self) -> Any:
        return elementwise("abs", self)

    def __invert__(self) -> Any:
        return invert(self)


class Array(Operand):
    """An array of a program: a node of the graph, or a view of another array, its base."""

    def __init__(
        self,
        node: int,
        batch_axis: int | None,
        base: Array | None = None,
        positions: np.ndarray | None = None,
        read_only: bool = False,
    ):
        self._node, self.batch_axis, self.read_only = node, batch_axis, read_only
        self.base = self if base is None else base
        self.positions = positions

    @property
    def node(self) -> int:
        """The node of its present numbers."""
        return self._node if self.positions is None else current_builder().gather(self.base.node, self.positions)

    @property
    def row_shape(self) -> tuple[int, ...]:
        """The shape in the graph."""
        return current_builder().nodes[self._node].shape if self.positions is None else self.positions.shape

    @property
    def shape(self) -> tuple[Any, ...]:
        """The shape that the program sees."""
        return tuple(BatchSize(n) if axis == self.batch_axis else n for axis, n in enumerate(self.row_shape))

    @property
    def ndim(self) -> int:
        return len(self.row_shape)

    @property
    def kind(self) -> Kind:
        return current_builder().nodes[self.base._node].kind

    @property
    def is_row_number(self) -> bool:
        """Whether it is `np.arange(batch)`."""
        return current_builder().nodes[self._node].op == "row_number"

    @property
    def constant(self) -> np.ndarray | None:
        """Its numbers, if they are the same in all rows and the array has no batch axis."""
        if self.batch_axis is not None:
            return None
        node = current_builder().nodes[self.node]
        return node.option if node.op == "constant" else None

    def number(self) -> Any:
        """The only number of a constant, as a number of Python."""
        values = self.constant
        if values is None:
            raise Refused("E-FLOW", "a number or a condition that differs from row to row: use np.where instead of if")
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

    def axis(self, axis: Any, extra: int = 0) -> int:
        """An axis, counted from the front. `extra` axes are about to be added."""
        number, ndim = operator.index(axis), self.ndim + extra
        if not -ndim <= number < ndim:
            raise IndexError(f"axis {number} is out of bounds for an array of the shape {self.shape}")
        return number % ndim

    def row_axes(self, axis: Any) -> tuple[int, ...]:
        """The axes of an operation along `axis`: one, several, or all for None. None of them may be the batch axis."""
        numbers = range(self.ndim) if axis is None else axis if isinstance(axis, (tuple, list, range)) else [axis]
        axes = tuple(sorted({self.axis(number) for number in numbers}))
        if self.batch_axis in axes:
            how = "without axis=" if axis is None else f"along axis {self.batch_axis}"
            raise Refused("E-ROWS", f"{how}, the shape {self.shape} is computed over the batch: use axis=1 or axis=-1")
        return axes

    # --- moving numbers -------------------------------------------------------------------------------------------------

    def rearranged(self, function: Callable[[np.ndarray], np.ndarray], batch_axis: int | None) -> Array:
        """Move numbers as a function of NumPy moves the positions of a row: into a view, if NumPy makes a view."""
        builder = current_builder()
        positions = all_positions(self.row_shape) if self.positions is None else self.positions
        builder.spend(positions.size)
        moved = np.asarray(function(positions))
        builder.check_size(moved.shape)
        if np.may_share_memory(moved, positions):
            return Array(self.base._node, batch_axis, self.base, moved)
        return Array(builder.gather(self.base.node, moved), batch_axis)

    def reshaped(self, row_shape: Sequence[int], batch_axis: int | None) -> Array:
        return self.rearranged(lambda positions: positions.reshape(row_shape), batch_axis)

    def transposed(self, axes: Sequence[int]) -> Array:
        """The axes in another order."""
        batch_axis = None if self.batch_axis is None else list(axes).index(self.batch_axis)
        return self.rearranged(lambda positions: positions.transpose(axes), batch_axis)

    def copy(self) -> Array:
        return Array(self.node, self.batch_axis)

    # --- indices --------------------------------------------------------------------------------------------------------

    def __getitem__(self, index: Any) -> Any:
        entries = self._entries(index)
        if _is_mask(entries[:1]):
            return Masked(self[self._behind_mask(entries)], entries[0])
        if any(isinstance(entry, Array) for entry in entries):
            positions = self._computed_positions(entries)
            return Array(current_builder().take(self.node, positions.node), positions.batch_axis)
        if self.batch_axis is not None and isinstance([e for e in entries if e is not None][self.batch_axis], int):
            shape = np.empty(self.row_shape)[tuple(0 if isinstance(entry, int) else entry for entry in entries)].shape
            return Array(current_builder().add("first_row", (), shape, self.kind), None)
        return self.rearranged(*self._fixed_index(entries))

    def __setitem__(self, index: Any, value: Any) -> None:
        entries = self._entries(index)
        if _is_mask(entries[:1]):
            region = self[index]
            if isinstance(value, Masked) and value.mask.node == region.mask.node:
                value = value.values
            elif isinstance(value, Array) and value.batch_axis is not None:
                raise ValueError(
                    "x[mask] = y has other numbers in each row: write x[mask] = y[mask], or np.where(mask, y, x)"
                )
            self[self._behind_mask(entries)] = elementwise(
                "where", region.mask_for(region.values), value, region.values
            )
        elif any(isinstance(entry, Array) for entry in entries):
            self._write_at(self._computed_positions(entries), value)
        else:
            select, batch_axis = self._fixed_index(entries)
            self._write(
                value, select(all_positions(self.row_shape) if self.positions is None else self.positions), batch_axis
            )

    def _write(self, value: Any, positions: np.ndarray, batch_axis: int | None) -> None:
        """Write into these positions of the base."""
        base, builder = self.base, current_builder()
        if base.read_only:
            raise ValueError("the inputs cannot be written into: copy them first, x = observation.copy()")
        node = builder.cast(broadcast(as_array(value), positions.shape, batch_axis).node, base.kind)
        sources = all_positions(base.row_shape).copy()
        sources.reshape(-1)[positions.reshape(-1)] = sources.size + np.arange(positions.size)
        base._node = builder.gather(builder.concat([base._node, node]), sources)

    def _write_at(self, positions: Array, value: Any) -> None:
        """Write at computed positions. If some are equal, the last value stays."""
        builder, size, count = current_builder(), math.prod(self.row_shape), math.prod(positions.row_shape)
        builder.check_size((count, size))
        values = builder.flatten(broadcast(as_array(value), positions.row_shape, positions.batch_axis).node)
        hits = builder.elementwise(
            "equal", builder.reshape(positions.node, (count, 1)), builder.constant(np.arange(size)[None])
        )
        backwards = builder.gather(hits, all_positions((count, size))[::-1])
        last = builder.elementwise("subtract", builder.constant(count - 1), builder.reduce("argmax", backwards, (0,)))
        old = builder.flatten(self.node)
        new = builder.where(builder.reduce("any", hits, (0,)), builder.take(values, last), old)
        self[...] = Array(builder.reshape(new, self.row_shape), self.batch_axis)

    def _entries(self, index: Any) -> list[Any]:
        """An index as an entry for each axis, and None for each new one: slices, integers, arrays of integers."""
        entries: list[Any] = []
        for entry in index if isinstance(index, tuple) else (index,):
            entry = as_array(entry) if isinstance(entry, (list, tuple, range)) else entry
            if isinstance(entry, slice):
                entries.append(self._slice(entry))
            elif isinstance(entry, Array) and entry.constant is not None:
                entries.extend(entry.constant.nonzero() if entry.kind == "bool" else [_integers(entry).constant])
            elif isinstance(entry, Array) or entry is None or entry is ...:
                entries.append(entry)
            elif isinstance(entry, (bool, float)):
                raise IndexError(f"{entry} is not an index: an index is an integer, a slice or an array of integers")
            else:
                entries.append(operator.index(entry))
        consumed = [
            entry.ndim if _is_mask([entry]) else 1 for entry in entries if entry is not None and entry is not ...
        ]
        ellipses = [i for i, entry in enumerate(entries) if entry is ...]
        if sum(consumed) > self.ndim or len(ellipses) > 1:
            raise IndexError(f"too many indices for an array of the shape {self.shape}")
        i = ellipses[0] if ellipses else len(entries)
        return [*entries[:i], *[ALL] * (self.ndim - sum(consumed)), *entries[i + 1 :]]

    def _slice(self, entry: slice) -> slice:
        stop = None if isinstance(entry.stop, BatchSize) and entry.start in (None, 0) else entry.stop
        return slice(*(None if end is None else operator.index(end) for end in (entry.start, stop, entry.step)))

    def _fixed_index(self, entries: Sequence[Any]) -> tuple[Callable[[np.ndarray], np.ndarray], int | None]:
        """What an index does to positions, and where the batch axis then is. NumPy finds it on an array without numbers."""
        axes = [entry for entry in entries if entry is not None]
        if self.batch_axis is not None and axes[self.batch_axis] not in (ALL, slice(0, None), slice(0, None, 1)):
            raise Refused(
                "E-ROWS", f"an index into the batch axis of the shape {self.shape} takes one row for all: write x[:, i]"
            )
        # An axis of length 0: the batch axis, or one behind all others.
        at = self.ndim if self.batch_axis is None else self.batch_axis
        shape, index = [*self.row_shape[:at], 0, *self.row_shape[at + 1 :]], tuple(entries)
        result = np.empty(shape)[index if self.batch_axis is not None else (*index, ALL)].shape
        if result.count(0) > 1:
            raise IndexError(f"a slice is empty: it lies beyond the end of an axis of the shape {self.shape}")
        batch_axis = None if self.batch_axis is None else result.index(0)
        current_builder().check_size([size or 1 for size in result])
        return lambda positions: np.asarray(positions[index]), batch_axis

    def _behind_mask(self, entries: Sequence[Any]) -> tuple[Any, ...]:
        """The index of all that a mask is about."""
        mask = entries[0]
        if mask.batch_axis != self.batch_axis or mask.row_shape != self.row_shape[: mask.ndim]:
            raise IndexError(f"a mask of the shape {mask.shape} does not fit an array of the shape {self.shape}")
        if not all(isinstance(entry, (int, slice)) for entry in entries[1:]):
            raise Refused("E-NUMPY", "beside a mask, an index has integers and slices only")
        return (ALL,) * mask.ndim + tuple(entries[1:])

    def _computed_positions(self, entries: Sequence[Any]) -> Array:
        """The positions of x[np.arange(batch), i, 2:4] in a row. Each row reads its own numbers, or those of a constant."""
        at_arrays = [i for i, entry in enumerate(entries) if not isinstance(entry, slice) and entry is not None]
        apart = at_arrays != list(range(at_arrays[0], at_arrays[-1] + 1))
        first = -1 if apart else at_arrays[0]  # if slices are between them, their axes come first in the result
        computed: Any = as_array(0)
        before: list[np.ndarray] = []
        behind: list[np.ndarray] = []
        axes = iter(range(self.ndim))
        for i, entry in enumerate(entries):
            axis = None if entry is None else next(axes)
            size, stride = (1, 0) if axis is None else (self.row_shape[axis], math.prod(self.row_shape[axis + 1 :]))
            if axis is not None and axis == self.batch_axis:
                if not isinstance(entry, Array) or not entry.is_row_number or size > 1:
                    raise Refused(
                        "E-ROWS",
                        "an index that differs from row to row begins with np.arange(batch): x[np.arange(len(x)), i]",
                    )
                own_row = Array(current_builder().constant(np.zeros(entry.row_shape, int)), entry.batch_axis)
                computed = elementwise("add", own_row, computed)
            elif isinstance(entry, slice) or entry is None:
                (behind if i > first else before).append(np.arange(size)[entry or ALL] * stride)
            else:
                index = elementwise("multiply", _within(as_array(entry), size), stride)
                computed = elementwise("add", index, computed)
        sizes = [len(steps) for steps in before], [len(steps) for steps in behind]
        current_builder().check_size((*sizes[0], *computed.row_shape, *sizes[1]))
        offsets = sum(np.meshgrid(*before, *behind, indexing="ij"), np.zeros((), int))
        offsets = np.reshape(offsets, (*sizes[0], *[1] * computed.ndim, *sizes[1]))
        shape = *[1] * len(before), *computed.row_shape, *[1] * len(behind)
        batch_axis = None if computed.batch_axis is None else len(before) + computed.batch_axis
        builder = current_builder()
        node = builder.elementwise("add", builder.reshape(computed.node, shape), builder.constant(offsets))
        return Array(node, batch_axis)


class Masked(Operand):
    """x[mask], where rows differ in what the mask selects. It can be computed with, and written to the same places."""

    def __init__(self, values: Array, mask: Array):
        self.values, self.mask = values, mask

    def mask_for(self, array: Array) -> Any:
        """The mask with as many axes as an array."""
        return self.mask[(..., *(None,) * (array.ndim - self.mask.ndim))]


class Complex(Operand):
    """A complex array, as two real ones. `complex_numbers.py` says what can be done with it."""

    def __init__(self, real: Any, imag: Any):
        self.real, self.imag = real, imag

    def __getitem__(self, index: Any) -> Complex:
        return Complex(self.real[index], self.imag[index])


def _is_mask(entries: Sequence[Any]) -> bool:
    return any(isinstance(entry, Array) and entry.kind == "bool" for entry in entries)


def _integers(index: Array) -> Array:
    if index.kind != "int":
        raise IndexError("an index must be made of integers: convert it with astype(int)")
    return index


def _within(index: Array, size: int) -> Array:
    """An index counted from the start of an axis. A computed index beyond the end stands for the last entry."""
    values = _integers(index).constant
    if values is not None and not (-size <= values.min() and values.max() < size):
        raise IndexError(f"an index is out of bounds for an axis of length {size}")
    builder = current_builder()
    node = builder.nodes[index.node]
    if node.op in ("argmin", "argmax", "argsort") and builder.nodes[node.inputs[0]].shape[node.option] <= size:
        return index
    index = elementwise("where", elementwise("less", index, 0), elementwise("add", index, size), index)
    return elementwise("minimum", elementwise("maximum", index, 0), size - 1)


# --- arrays of values, and of other arrays ------------------------------------------------------------------------------


def as_array(value: Any) -> Array:
    """An array, a number, or nested lists of numbers and arrays, as an array."""
    if isinstance(value, Array):
        return value
    if isinstance(value, (bool, int, float, np.ndarray, np.generic)):
        return Array(current_builder().constant(value), None)
    if isinstance(value, (list, tuple, range)) and len(value):
        current_builder().spend(len(value))
        if all(isinstance(item, (bool, int, float)) for item in value):
            return Array(current_builder().constant(list(value)), None)
        return stack([as_array(item) for item in value], 0)
    if isinstance(value, BatchSize):
        value.refuse()
    if isinstance(value, Masked):
        raise Refused(
            "E-ROWS", "x[mask] can only be computed with, and written to the same places: use np.where(mask, x, 0)"
        )
    raise TypeError(
        "an empty list has no numbers" if value in ([], ()) else f"no array can be made of a {type(value).__name__}"
    )


COMPLEX_OPERATIONS: dict[str, Callable[..., Any]] = {}
"""What `elementwise` does if an operand is complex; `complex_numbers.py` fills it."""


def elementwise(op: str, *operands: Any) -> Any:
    """An operation on each number of arrays, which are broadcast to each other."""
    if any(isinstance(operand, (complex, Complex)) for operand in operands):
        if op not in COMPLEX_OPERATIONS:
            raise Refused("E-NUMPY", f"{op} of complex numbers is not available: use np.abs, np.angle, .real or .imag")
        return COMPLEX_OPERATIONS[op](*operands)
    masks = {operand.mask.node: operand.mask for operand in operands if isinstance(operand, Masked)}
    if masks:
        if len(masks) > 1:
            raise Refused("E-ROWS", "x[mask] and y[other_mask] have different numbers of entries: use np.where")
        result = elementwise(op, *(value.values if isinstance(value, Masked) else value for value in operands))
        return Masked(result, *masks.values())
    arrays = [as_array(operand) for operand in operands]
    batch_axis = common_batch_axis(arrays)
    nodes = [array.node for array in arrays]
    builder = current_builder()
    return Array(builder.where(*nodes) if op == "where" else builder.elementwise(op, *nodes), batch_axis)


def power(x: Any, exponent: Any) -> Any:
    """X ** exponent. Small whole powers are products, and half a power is a square root."""
    value = (
        exponent
        if isinstance(exponent, (int, float))
        else exponent
        if isinstance(exponent, Operand)
        else as_array(exponent)
    )
    if isinstance(value, Array) and value.constant is not None and not value.ndim:
        value = value.constant.item()
    if isinstance(value, (int, float)) and value in (0.5, 1, 2, 3, 4):
        if value == 0.5:
            return elementwise("sqrt", x)
        if isinstance(value, float):
            x = elementwise("multiply", x, 1.0)
        x = x if isinstance(x, Operand) else as_array(x)
        square = elementwise("multiply", x, x)
        powers = {1: lambda: x, 2: lambda: square, 3: lambda: elementwise("multiply", square, x)}
        return powers.get(int(value), lambda: elementwise("multiply", square, square))()
    return elementwise("power", x, exponent)


def invert(x: Any) -> Any:
    """~x: not, of truth values; -x - 1, of integers."""
    kind = (x.values if isinstance(x, Masked) else x).kind
    if kind == "float":
        raise TypeError("~ of fractional numbers: it acts on conditions, as ~(x > 0)")
    return elementwise("logical_not", x) if kind == "bool" else elementwise("subtract", -1, x)


def common_batch_axis(arrays: Sequence[Array]) -> int | None:
    """The batch axis of arrays that are broadcast to each other."""
    ndim = max(array.ndim for array in arrays)
    from_end = {array.ndim - array.batch_axis for array in arrays if array.batch_axis is not None}
    shapes = " and ".join(str(array.shape) for array in arrays)
    if not from_end:
        return None
    if len(from_end) > 1:
        raise Refused("E-ROWS", f"the shapes {shapes} combine each row with all others: use keepdims=True or [:, None]")
    (behind,) = from_end
    lengths = {array.row_shape[-behind] for array in arrays if array.batch_axis is not None}
    fixed = {array.row_shape[-behind] for array in arrays if array.batch_axis is None and array.ndim >= behind}
    if len(lengths) > 1 or fixed - {1}:
        raise ValueError(f"the shapes {shapes} cannot be broadcast together, for any number of rows")
    return ndim - behind


def broadcast(array: Array, row_shape: Sequence[int], batch_axis: int | None) -> Array:
    """An array that is repeated to a shape."""
    current_builder().check_size(row_shape)
    target = Array(current_builder().constant(np.broadcast_to(np.zeros(()), row_shape)), batch_axis)
    shape = np.broadcast_shapes(array.row_shape, tuple(row_shape))
    if common_batch_axis([array, target]) != batch_axis or shape != tuple(row_shape):
        raise ValueError(f"an array of the shape {array.shape} cannot be broadcast to the shape {target.shape}")
    return array.rearranged(lambda positions: np.broadcast_to(positions, row_shape), batch_axis)


def stack(arrays: Sequence[Array], axis: Any) -> Array:
    """Arrays along a new axis."""
    at = arrays[0].axis(axis, extra=1)
    if len({array.row_shape for array in arrays}) > 1 or len({array.batch_axis for array in arrays}) > 1:
        shapes = " and ".join(dict.fromkeys(str(array.shape) for array in arrays))
        raise ValueError(f"arrays that are stacked must have the same shape: {shapes}")
    return concatenate([array[(*(ALL,) * at, None)] for array in arrays], at)


def concatenate(arrays: Sequence[Array], axis: Any) -> Array:
    """Arrays one after the other along an axis."""
    first = arrays[0]
    (at,) = first.row_axes(axis)
    sides = {(array.batch_axis, array.row_shape[:at], array.row_shape[at + 1 :]) for array in arrays}
    if len(sides) > 1:
        shapes = " and ".join(dict.fromkeys(str(array.shape) for array in arrays))
        raise ValueError(f"the shapes {shapes} cannot be joined along axis {at}")
    builder = current_builder()
    kind = widest([array.kind for array in arrays])
    positions, start = [], 0
    for array in arrays:
        positions.append(all_positions(array.row_shape) + start)
        start += positions[-1].size
    builder.check_size((start,))
    node = builder.concat([builder.cast(array.node, kind) for array in arrays])
    return Array(builder.gather(node, np.concatenate(positions, at)), first.batch_axis)
