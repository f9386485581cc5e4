"""What an index means: x[:, 1:3], x[:, None], x[np.arange(batch), i].

Fixed indices move positions as NumPy would move numbers. Computed indices become an array of positions, which `take` reads.
Arrays are recognised by their attributes, because arrays.py imports this file.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lare_rl.phi.batch_axis import BatchSize, Layout
from lare_rl.phi.builder import current_builder
from lare_rl.phi.graph import all_positions
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.rearrange import Source

__all__ = ["ALL", "computed_positions", "fixed_index", "index_entries", "is_mask", "masked_index", "overwrite"]

ALL = slice(None)


def is_mask(entry: Any) -> bool:
    """Return whether an entry of an index is an array of truth values."""
    return hasattr(entry, "is_row_number") and entry.kind == "bool"


def index_entries(layout: Layout, items: Sequence[Any]) -> list[Any]:
    """Return an index as an entry for each axis, and None for each new one: slices, integers, arrays of integers."""
    n_axes = sum(item.ndim if is_mask(item) else 1 for item in items if item is not None and item is not ...)
    n_ellipses = sum(item is ... for item in items)
    if n_axes > layout.ndim or n_ellipses > 1:
        raise IndexError(f"too many indices for an array of the shape {layout.shape}")
    entries: list[Any] = []
    for item in items if n_ellipses else (*items, ...):
        if item is ...:
            entries.extend([ALL] * (layout.ndim - n_axes))
        elif item is None or isinstance(item, slice):
            axis = sum(entry is not None for entry in entries)
            entries.append(None if item is None else _read_slice(item, layout.shape[axis]))
        elif is_mask(item) and item.constant is not None:
            start = sum(entry is not None for entry in entries)
            if item.row_shape != layout.row_shape[start : start + item.ndim]:
                raise IndexError(f"a mask of the shape {item.shape} does not fit an array of the shape {layout.shape}")
            entries.extend(item.constant.nonzero())
        elif hasattr(item, "is_row_number"):
            values = None if item.constant is None else _check_integers(item).constant
            # With an integer of NumPy, as with an int, the result is a view.
            entries.append(item if values is None else values if values.ndim else int(values))
        elif isinstance(item, (bool, float)):
            raise IndexError(f"{item} is not an index: an index is an integer, a slice or an array of integers")
        else:
            entries.append(operator.index(item))
    return entries


def _read_slice(entry: slice, length: Any) -> slice:
    """Return a slice of an axis of this length. The end of a batch axis is its length."""
    is_end = isinstance(entry.stop, BatchSize) and isinstance(length, BatchSize) and entry.stop.factor == length.factor
    stop = None if is_end and entry.start in (None, 0) else entry.stop
    return slice(*(None if end is None else operator.index(end) for end in (entry.start, stop, entry.step)))


def fixed_index(source: Source, entries: Sequence[Any]) -> Source:
    """Return the positions that an index selects.

    Raises:
        RefusedError: it selects rows of the batch, or too many numbers.
    """
    layout = source.layout
    axes = [entry for entry in entries if entry is not None]
    if layout.batch_axis is not None and not _is_all(axes[layout.batch_axis]):
        raise RefusedError("E-ROWS", f"an index into the rows of {layout.shape} takes one row for all: write x[:, i]")
    # NumPy finds the shape on an array without numbers: the batch axis, or else a last axis, has the length 0.
    at = layout.ndim if layout.batch_axis is None else layout.batch_axis
    index = (*entries, ALL) if layout.batch_axis is None else tuple(entries)
    shape = np.empty((*layout.row_shape[:at], 0, *layout.row_shape[at + 1 :]))[index].shape
    is_empty = shape.count(0) > 1
    current_builder().spend(current_builder().check_size([0 if is_empty else max(size, 1) for size in shape]))
    if layout.batch_axis is None:
        return Source(np.asarray(source.positions[tuple(entries)]), None)
    two_rows = None if source.two_rows is None else source.two_rows[tuple(entries)]
    return Source(source.positions[tuple(entries)], shape.index(0), two_rows)


def _is_all(entry: Any) -> bool:
    is_slice = isinstance(entry, slice)
    return is_slice and entry.start in (None, 0) and entry.stop is None and entry.step in (None, 1)


def masked_index(layout: Layout, entries: Sequence[Any]) -> tuple[Any, ...]:
    """Return the index of all numbers that the mask in front of an index may select."""
    mask = entries[0]
    if mask.batch_axis != layout.batch_axis or mask.row_shape != layout.row_shape[: mask.ndim]:
        raise IndexError(f"a mask of the shape {mask.shape} does not fit an array of the shape {layout.shape}")
    if not all(isinstance(entry, (int, slice)) for entry in entries[1:]):
        raise RefusedError("E-NUMPY", "an index with a mask may contain integers and slices only")
    return (ALL,) * mask.ndim + tuple(entries[1:])


def computed_positions(layout: Layout, entries: Sequence[Any], as_array: Callable[[Any], Any]) -> Any:
    """Return the array of the positions of x[np.arange(batch), i, 2:4] in a row.

    Each row reads its own numbers, or those of a constant. A computed index beyond the end of an axis stands for the last
    entry.
    """
    computed = as_array(0)
    axes = iter(range(layout.ndim))
    for entry in entries:
        axis = None if entry is None else next(axes)
        size, stride = (1, 0) if axis is None else (layout.row_shape[axis], math.prod(layout.row_shape[axis + 1 :]))
        if axis is not None and axis == layout.batch_axis:
            if entry is None or not getattr(entry, "is_row_number", False) or not _counts_up(entry, size):
                raise RefusedError("E-ROWS", "an index that differs from row to row is x[np.arange(len(x)), i]")
            rows = as_array(np.arange(size) * stride).reshaped(entry.row_shape, entry.batch_axis)
            computed = rows + computed
        elif not isinstance(entry, slice) and entry is not None:
            computed = _clamp(as_array(entry), size) * stride + computed
    arrays = [i for i, entry in enumerate(entries) if not isinstance(entry, slice) and entry is not None]
    starts = all_positions(layout.row_shape)[tuple(0 if i in arrays else entry for i, entry in enumerate(entries))]
    current_builder().check_size((*starts.shape, *computed.row_shape))
    # If slices are between arrays, the axes of the arrays come first in the result.
    before = arrays[0] if arrays == list(range(arrays[0], arrays[-1] + 1)) else 0
    behind = starts.ndim - before
    starts = starts.reshape((*starts.shape[:before], *[1] * computed.ndim, *starts.shape[before:]))
    batch_axis = None if computed.batch_axis is None else before + computed.batch_axis
    return computed.reshaped((*[1] * before, *computed.row_shape, *[1] * behind), batch_axis).copy() + starts


def _counts_up(row_number: Any, size: int) -> bool:
    """Return whether a view of row numbers has each of them once, in order."""
    return np.array_equal(row_number.source.positions.ravel(), np.arange(size))


def overwrite(old: int, positions: int, values: int) -> int:
    """Return the node of an array after writing at computed positions. Of values at equal positions, the last one stays."""
    builder = current_builder()
    shape, count = builder.nodes[old].shape, math.prod(builder.nodes[positions].shape)
    size = math.prod(shape)
    values = builder.flatten(values)
    hits = builder.elementwise("equal", builder.reshape(positions, (count, 1)), builder.constant(np.arange(size)[None]))
    backwards = builder.gather(hits, all_positions((count, size))[::-1])
    last = builder.elementwise("subtract", builder.constant(count - 1), builder.reduce("argmax", backwards, (0,)))
    old = builder.flatten(old)
    new = builder.where(builder.reduce("any", hits, (0,)), builder.take(values, last), old)
    return builder.reshape(new, shape)


def _clamp(index: Any, size: int) -> Any:
    """Return an index counted from the start of an axis. A computed index beyond the end stands for the last entry."""
    values = _check_integers(index).constant
    if values is not None and not (-size <= values.min() and values.max() < size):
        raise IndexError(f"an index is out of bounds for an axis of length {size}")
    nodes = current_builder().nodes
    node = nodes[index.node]
    if node.op in ("argmin", "argmax", "argsort") and nodes[node.inputs[0]].shape[node.option] <= size:
        return index
    index = index.apply("where", index < 0, index + size, index)
    return index.apply("minimum", index.apply("maximum", index, 0), size - 1)


def _check_integers(index: Any) -> Any:
    if index.kind != "int":
        raise IndexError("an index must be made of integers: convert it with astype(int)")
    return index
