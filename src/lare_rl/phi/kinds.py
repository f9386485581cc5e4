"""Kinds of numbers: which kind an operation on each number takes, and which it gives. The rules are those of NumPy."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, get_args

from lare_rl.phi.graph import Kind

__all__ = ["ELEMENTWISE", "Typed", "elementwise_kinds", "widest"]

KINDS: tuple[Kind, ...] = get_args(Kind)
"""From the narrowest to the widest."""

ELEMENTWISE: dict[str, str] = {
    **dict.fromkeys(
        "sqrt exp log log1p expm1 exp2 log2 log10 cbrt sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arccosh arctanh "
        "arctan2 hypot logaddexp logaddexp2 divide".split(),
        "float",
    ),
    **dict.fromkeys(
        "abs negative sign floor ceil trunc rint maximum minimum fmax fmin add subtract multiply power remainder fmod "
        "floor_divide copysign".split(),
        "same",
    ),
    **dict.fromkeys("less less_equal greater greater_equal equal not_equal isnan isinf isfinite signbit".split(), "bool"),
    **dict.fromkeys("logical_and logical_or logical_xor logical_not".split(), "logical"),
    **dict.fromkeys("bitwise_and bitwise_or bitwise_xor left_shift right_shift".split(), "int"),
}  # fmt: skip
"""Operations on each number by NumPy's names, and the kind of their results: float, that of the operands ("same"), or bool.
Operands of "logical" operations become bool. Operands of "int" operations must be integers."""

_ON_BOOL = {"add": "logical_or", "maximum": "logical_or", "multiply": "logical_and", "minimum": "logical_and"}
"""What NumPy makes of arithmetic on bool arrays."""


class Typed(NamedTuple):
    """An operation with the kind that its operands are cast to and the kind of its result. `op` is None if nothing is to be done."""

    op: str | None
    operands: Kind
    result: Kind


@lru_cache(1024)
def elementwise_kinds(op: str, kinds: tuple[Kind, ...], negative_exponent: bool = False) -> Typed:
    """Return which operation NumPy applies to operands of these kinds."""
    result, kind = ELEMENTWISE[op], widest(kinds)
    if result == "int":
        if kind == "float":
            raise TypeError(f"{op} of fractional numbers: write (a > b) & (c > d), or convert with astype(int)")
        if kind == "bool" and op.startswith("bitwise"):
            op, result = op.replace("bitwise", "logical"), "logical"
        else:
            result, kind = "same", "int"
    if result == "same" and kind == "bool":
        if op in ("subtract", "negative", "sign"):
            raise TypeError(f"{op} of truth values: use np.logical_xor, ~ or astype(float)")
        if op == "abs":
            return Typed(None, kind, kind)
        if op in _ON_BOOL:
            op, result = _ON_BOOL[op], "logical"
        else:
            kind = "int"
    if op in ("floor", "ceil", "trunc", "rint") and kind == "int":
        return Typed(None, kind, kind)
    if op == "copysign" or (op == "power" and kind == "int" and negative_exponent):
        kind = "float"
    operands: Kind = "float" if result == "float" else "bool" if result == "logical" else kind
    return Typed(op, operands, "bool" if result in ("bool", "logical") else operands)


def widest(kinds: Sequence[str]) -> Kind:
    """Return the kind that can hold numbers of all these kinds."""
    return max(KINDS, key=lambda kind: kind in kinds and KINDS.index(kind))
