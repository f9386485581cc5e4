"""What Python's operators act on in a program: arrays, what is computed like one, and the number of rows."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Never

from lare_rl.phi.limits import RefusedError

if TYPE_CHECKING:
    from lare_rl.phi.arrays import Array

__all__ = ["BATCH", "BatchSize", "Operand", "common_batch_axis", "program_shape"]


def _operators(op: str) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]:
    """Return the methods of an operator, for an operand on its left and for one on its right."""
    return lambda self, other: self.apply(op, self, other), lambda self, other: self.apply(op, other, self)


class Operand:
    """A value with the operators of NumPy's arrays. A subclass defines `apply`."""

    __array_ufunc__ = None
    __hash__ = object.__hash__

    def apply(self, op: str, *operands: Any) -> Any:
        """Apply an operation on each number, by NumPy's name, to operands. This is one of them."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return "<array>"

    def __bool__(self) -> bool:
        raise RefusedError("E-FLOW", "a condition that differs from row to row: use np.where instead of if")

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("subtract")
    __mul__, __rmul__ = _operators("multiply")
    __truediv__, __rtruediv__ = _operators("divide")
    __floordiv__, __rfloordiv__ = _operators("floor_divide")
    __mod__, __rmod__ = _operators("remainder")
    __pow__, __rpow__ = _operators("power")
    __and__, __rand__ = _operators("bitwise_and")
    __or__, __ror__ = _operators("bitwise_or")
    __xor__, __rxor__ = _operators("bitwise_xor")
    __lshift__, __rlshift__ = _operators("left_shift")
    __rshift__, __rrshift__ = _operators("right_shift")
    __lt__, __gt__ = _operators("less")
    __le__, __ge__ = _operators("less_equal")
    __eq__, __ne__ = _operators("equal")[0], _operators("not_equal")[0]

    def __neg__(self) -> Any:
        return self.apply("negative", self)

    def __pos__(self) -> Any:
        return self

    def __abs__(self) -> Any:
        return self.apply("abs", self)

    def __invert__(self) -> Any:
        return self.apply("invert", self)


# --- the batch axis --------------------------------------------------------------------------------------------------


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
    __le__ = __bool__ = __index__ = __int__ = __float__ = __neg__ = __abs__ = __round__ = refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __truediv__ = __rtruediv__ = __rfloordiv__ = refuse
    __mod__ = __rmod__ = __pow__ = __rpow__ = __divmod__ = refuse


BATCH = BatchSize()


def program_shape(row_shape: Sequence[int], batch_axis: int | None) -> tuple[Any, ...]:
    """Return the shape that the program sees of an array."""
    return tuple(BatchSize(n) if axis == batch_axis else n for axis, n in enumerate(row_shape))


def common_batch_axis(arrays: Sequence[Array]) -> int | None:
    """Return the batch axis of the result, if arrays are broadcast to each other.

    Raises:
        RefusedError: their batch axes do not meet, so that each row would be combined with all others.
        ValueError: they cannot be broadcast for any number of rows.
    """
    ndim = max(array.ndim for array in arrays)
    axes_from_end = {array.ndim - array.batch_axis for array in arrays if array.batch_axis is not None}
    if not axes_from_end:
        return None
    shapes = " and ".join(str(array.shape) for array in arrays)
    if len(axes_from_end) > 1:
        text = f"the shapes {shapes} combine each row with all others: use keepdims=True or [:, None]"
        raise RefusedError("E-ROWS", text)
    (from_end,) = axes_from_end
    lengths = {array.row_shape[-from_end] for array in arrays if array.batch_axis is not None}
    fixed = {array.row_shape[-from_end] for array in arrays if array.batch_axis is None and array.ndim >= from_end}
    if len(lengths) > 1 or fixed - {1}:
        raise ValueError(f"the shapes {shapes} cannot be broadcast together, for any number of rows")
    return ndim - from_end
