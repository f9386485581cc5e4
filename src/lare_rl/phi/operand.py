"""What Python's operators act on in a program: arrays, and what is computed like one."""

from collections.abc import Callable
from typing import Any

from lare_rl.phi.limits import RefusedError

__all__ = ["Operand"]


def _operators(op: str) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]:
    """Return the methods of an operator, for an operand on its left and for one on its right."""
    return lambda self, other: self.apply(op, self, other), lambda self, other: self.apply(op, other, self)


class Operand:
    """A value with the operators of NumPy's arrays. A subclass defines `apply`."""

    __array_ufunc__ = None
    __hash__ = object.__hash__

    def apply(self, op: str, *operands: Any) -> Any:
        """Apply an operation on each number, by NumPy's name, to operands, of which this value is one."""
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
