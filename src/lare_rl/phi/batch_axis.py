"""The batch axis of an array: its length, which a program does not know, and what it means for shapes."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, Never

from lare_rl.phi.limits import RefusedError

__all__ = ["BATCH", "BatchSize", "Layout", "common_batch_axis"]


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
        text = "no factor can depend on the number of rows, and no loop can go over them: use columns, x[:, i]"
        raise RefusedError("E-ROWS", text)

    def __hash__(self) -> int:
        return hash(self.factor)

    __rmul__ = __mul__

    def __bool__(self) -> bool:
        return True

    __le__ = __index__ = __int__ = __float__ = __neg__ = __abs__ = __round__ = refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __truediv__ = __rtruediv__ = __rfloordiv__ = refuse
    __mod__ = __rmod__ = __pow__ = __rpow__ = __divmod__ = refuse


BATCH = BatchSize()


class Layout(NamedTuple):
    """The axes of an array."""

    row_shape: tuple[int, ...]
    """Shape in the graph."""
    batch_axis: int | None

    @property
    def ndim(self) -> int:
        return len(self.row_shape)

    @property
    def shape(self) -> tuple[Any, ...]:
        """Shape that the program sees."""
        return tuple(BatchSize(n) if axis == self.batch_axis else n for axis, n in enumerate(self.row_shape))


def common_batch_axis(layouts: Sequence[Layout]) -> int | None:
    """Return the batch axis of the result, if arrays are broadcast to each other.

    Raises:
        RefusedError: their batch axes do not meet, so that each row would be combined with all others.
        ValueError: they cannot be broadcast for any number of rows.
    """
    ndim = max(x.ndim for x in layouts)
    axes_from_end = {x.ndim - x.batch_axis for x in layouts if x.batch_axis is not None}
    if not axes_from_end:
        return None
    shapes = " and ".join(str(x.shape) for x in layouts)
    if len(axes_from_end) > 1:
        text = f"the shapes {shapes} combine each row with all others: use keepdims=True or [:, None]"
        raise RefusedError("E-ROWS", text)
    (from_end,) = axes_from_end
    lengths = {x.row_shape[-from_end] for x in layouts if x.batch_axis is not None}
    fixed = {x.row_shape[-from_end] for x in layouts if x.batch_axis is None and x.ndim >= from_end}
    if len(lengths) > 1 or fixed - {1}:
        raise ValueError(f"the shapes {shapes} cannot be broadcast together, for any number of rows")
    return ndim - from_end
