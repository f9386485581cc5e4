"""Rearranges numbers as NumPy does: NumPy's own function is applied to the positions of the numbers of a row.

The same function is then applied to two and to three rows, whose numbers have labels: position + row * `size`. The axis that
grows with the number of rows is the batch axis of the result. Each of its rows must read the same positions of the same row,
or numbers that are the same for all rows; else the function is refused, because it would mix, add or leave out rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lare_rl.phi.batch_axis import BatchSize, Layout
from lare_rl.phi.builder import current_builder
from lare_rl.phi.limits import RefusedError

__all__ = ["Source", "leaves", "map_leaves", "move"]


class Source(NamedTuple):
    """Positions of the numbers of an array, for one row."""

    positions: np.ndarray
    batch_axis: int | None
    two_rows: np.ndarray | None = None
    """The same view of the labels of two rows. It shares memory with other views as the arrays of the program do."""

    @property
    def layout(self) -> Layout:
        return Layout(self.positions.shape, self.batch_axis)

    def labels(self, n_rows: int, size: int) -> np.ndarray:
        """Return the labels of some rows. Numbers without a batch axis count as a row behind all others."""
        if self.batch_axis is None:
            return np.asarray(self.positions + n_rows * size)
        if n_rows == 2 and self.two_rows is not None:
            return self.two_rows
        return np.concatenate([self.positions + row * size for row in range(n_rows)], self.batch_axis)


def leaves(nested: Any) -> list[Any]:
    """Return the entries of nested lists."""
    return [leaf for item in nested for leaf in leaves(item)] if type(nested) is list else [nested]


def map_leaves(function: Callable[[Any], Any], nested: Any) -> Any:
    return [map_leaves(function, item) for item in nested] if type(nested) is list else function(nested)


def move(
    function: Callable[..., Any], sources: Any, args: Sequence[Any], size: int
) -> list[Source] | tuple[Source, ...] | Source:
    """Apply a function of NumPy that only moves, repeats and leaves out numbers.

    Args:
        sources: the first argument of the function: a `Source`, or nested lists of them.
        args: the other arguments. Lengths of batch axes become numbers, and constant arrays become arrays of NumPy.
        size: more than all positions; -1 is a number that the function adds.

    Raises:
        RefusedError: the rows of the result would not be those of the sources.
    """
    inputs = leaves(sources)

    def apply(n_rows: int) -> Any:
        rows = map_leaves(lambda source: source.labels(n_rows, size) if n_rows > 1 else source.positions, sources)
        return function(rows, *(_plain(value, n_rows) for value in args))

    shapes = " and ".join(dict.fromkeys(str(x.layout.shape) for x in inputs))
    try:
        result = apply(1)
    except (ValueError, IndexError) as error:
        kind = IndexError if isinstance(error, IndexError) else ValueError
        raise kind(f"{error}, for {shapes}") from None
    several = isinstance(result, (list, tuple))
    results = [list(map(np.asarray, result if several else [result]))]
    for positions in results[0]:
        current_builder().spend(current_builder().check_size(positions.shape))
    if all(source.batch_axis is None for source in inputs) and _plain(args, 2) == _plain(args, 3):
        moved = [Source(positions, None) for positions in results[0]]
    else:
        try:
            results += [apply(n) if several else [apply(n)] for n in (2, 3)]
            moved = [_to_source(*labels, size=size) for labels in zip(*results, strict=True)]
        except (ValueError, IndexError):
            text = f"rows of {shapes} would be mixed, added or left out: use axis=1 or axis=-1, and keep the batch axis"
            raise RefusedError("E-ROWS", text) from None
    return type(result)(moved) if several else moved[0]


def _to_source(positions: np.ndarray, two_rows: np.ndarray, three_rows: np.ndarray, size: int) -> Source:
    """Return one row of a result. Raises `ValueError` if its other rows are not like it."""
    shapes = zip(two_rows.shape, three_rows.shape, strict=True)
    growing = [axis for axis, lengths in enumerate(shapes) if lengths[0] != lengths[1]]
    source = Source(positions, growing[0] if growing else None)
    for n_rows, labels in ((2, two_rows), (3, three_rows)):
        expected = Source(positions % size, source.batch_axis).labels(n_rows, size)
        shared = (labels < 0) | (labels >= n_rows * size)
        if labels.shape != expected.shape or not np.all(
            (labels == expected) | (shared & (labels % size == expected % size))
        ):
            raise ValueError("rows differ")
    return source._replace(two_rows=two_rows)


def _plain(value: Any, n_rows: int) -> Any:
    """Return an argument as NumPy takes it, for a number of rows."""
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item, n_rows) for item in value)
    numbers = getattr(value, "constant", value)
    if numbers is None and value is not None:
        raise RefusedError("E-NUMPY", "positions and lengths must be the same for all rows")
    return value.factor * n_rows if isinstance(value, BatchSize) else numbers
