"""A function of one row, as a list of typed array operations.

The shapes of a graph do not include the batch, and no operation can reach another row, so rows are independent by
construction. `evaluate` computes any number of rows by giving every array batch axes in front.

    bool, int, float      the kinds of numbers: bool, int32 and float32 when a graph is computed
    input, constant       arrays of the caller, and arrays that never change
    those in ELEMENTWISE, where, cast                                 on each number
    sum, prod, max, min, any, all, argmax, argmin                     along axes
    cumsum, cumprod, sort, argsort                                    along one axis
    einsum, det                                                       products
    gather        numbers at fixed positions: every slice, reshape, transpose, flip, repetition
    take          numbers at computed positions of an array with one axis
    concat        arrays with one axis, one after the other
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

__all__ = ["ELEMENTWISE", "KIND_OF_CODE", "Gather", "Graph", "Node", "NumberKind", "elementwise_kinds", "widest"]

NumberKind = Literal["bool", "int", "float"]


class Node(NamedTuple):
    """An operation and its result. `inputs` are indices of earlier nodes."""

    op: str
    inputs: tuple[int, ...]
    shape: tuple[int, ...]
    """Shape of the result, for one row."""
    kind: NumberKind
    option: Any = None
    """What else the operation needs: axes, positions, a pattern, the name of an input, the numbers of a constant."""
    line: int = 0
    """Line of the source that it was read from."""


class Gather(NamedTuple):
    """The numbers that a `gather` reads. Positions that form a box are read by slices."""

    positions: np.ndarray
    slices: tuple[slice, ...] | None


@dataclass(frozen=True, eq=False)
class Graph:
    """Operations, sorted: each one stands after the operations whose results it reads."""

    nodes: tuple[Node, ...]
    outputs: dict[str, int]

    @cached_property
    def unused_after(self) -> list[list[int]]:
        """For each operation, the results that nothing needs afterwards."""
        last_use = {i: user for user, node in enumerate(self.nodes) for i in node.inputs}
        unused: list[list[int]] = [[] for _ in self.nodes]
        for i, user in last_use.items():
            if i not in self.outputs.values():
                unused[user].append(i)
        return unused

    @property
    def inputs(self) -> dict[str, Node]:
        return {node.option: node for node in self.nodes if node.op == "input"}

    @property
    def n_factors(self) -> int:
        """Length of the output "factors"."""
        return self.nodes[self.outputs["factors"]].shape[0]

    @property
    def operations(self) -> list[Node]:
        return [node for node in self.nodes if node.op not in ("input", "constant")]

    @property
    def size(self) -> int:
        """How many numbers the operations compute for each row."""
        return sum(self.cost(node) for node in self.operations)

    def cost(self, node: Node) -> int:
        """Return how many numbers an operation computes for each row. A product of arrays counts all its terms."""
        if node.op != "einsum":
            return math.prod(node.shape)
        terms = node.option.partition("->")[0].replace("...", "").split(",")
        return math.prod(letter_sizes(terms, [self.nodes[i].shape for i in node.inputs]).values())

    @property
    def depth(self) -> int:
        """Length of the longest chain of operations that each need the result of the one before."""
        depths: list[int] = []
        for node in self.nodes:
            depths.append(max((depths[i] for i in node.inputs), default=-1) + 1)
        return max(depths, default=0)

    def entries_read(self, output: str) -> list[dict[str, list[int]]]:
        """Return, for each number of an output, the entries of each input that it may depend on."""
        inputs = [(i, node.option) for i, node in enumerate(self.nodes) if node.op == "input"]
        entries = []
        for number in range(math.prod(self.nodes[self.outputs[output]].shape)):
            needed = self.needed_for(output, number)
            entries.append({name: np.flatnonzero(needed[i]).tolist() if i in needed else [] for i, name in inputs})
        return entries

    def needed_for(self, output: str, number: int) -> dict[int, np.ndarray]:
        """Return what the entry `number` of an output may depend on: by the index of a node, a mask of its entries.

        An entry that is multiplied by a constant zero counts too.
        """
        last = self.outputs[output]
        needed = {last: np.arange(math.prod(self.nodes[last].shape)) == number}
        for i in range(last, -1, -1):
            node = self.nodes[i]
            if i in needed and node.op not in ("input", "constant"):
                shapes = [self.nodes[j].shape for j in node.inputs]
                masks = _needed_inputs(node, needed[i].reshape(node.shape), shapes)
                for j, mask in zip(node.inputs, masks, strict=True):
                    if mask.any():
                        needed[j] = needed.get(j, False) | mask.reshape(-1)
        return needed


def _needed_inputs(node: Node, needed: np.ndarray, shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    """Return, for each input of an operation, a mask of the numbers that its needed results may depend on."""
    masks = [np.zeros(shape, bool) for shape in shapes]
    match node.op:
        case "gather":
            masks[0].reshape(-1)[node.option.positions[needed]] = True
        case "concat":
            masks = list(np.split(needed, np.cumsum([shape[0] for shape in shapes])[:-1]))
        case "take":
            masks = [np.ones(shapes[0], bool), _undo_broadcast(needed, shapes[1])]
        case "einsum":
            terms, _, result = node.option.replace("...", "").partition("->")
            for mask, term in zip(masks, terms.split(","), strict=True):
                letters = "".join(dict.fromkeys(term))  # a repeated letter reads a diagonal
                positions = np.einsum(f"{term}->{letters}", all_positions(mask.shape))
                read = np.einsum(f"{result},{term}->{letters}", needed, np.ones(mask.shape, bool))
                mask.reshape(-1)[positions] = read
        case "det":
            masks = [np.broadcast_to(needed[..., None, None], shapes[0])]
        case "sum" | "prod" | "max" | "min" | "any" | "all" | "argmax" | "argmin":
            masks[0] |= np.expand_dims(needed, node.option)
        case "cumsum" | "cumprod":  # an entry reads those before it
            masks = [np.flip(np.logical_or.accumulate(np.flip(needed, node.option), node.option), node.option)]
        case "sort" | "argsort":
            masks[0] |= needed.any(node.option, keepdims=True)
        case _:
            masks = [_undo_broadcast(needed, shape) for shape in shapes]
    return masks


def _undo_broadcast(needed: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return which numbers of an array are needed, if it was broadcast to the shape of `needed`."""
    padded = (1,) * (needed.ndim - len(shape)) + shape
    axes = tuple(axis for axis, size in enumerate(padded) if size == 1)
    return np.asarray(needed.any(axes, keepdims=True)).reshape(shape)


def letter_sizes(terms: Sequence[str], shapes: Sequence[tuple[int, ...]]) -> dict[str, int]:
    """Return the length of the axis that each letter of an einsum stands for."""
    sizes: dict[str, int] = {}
    for term, shape in zip(terms, shapes, strict=True):
        for letter, size in zip(term, shape, strict=True):
            if sizes.setdefault(letter, size) != size:
                raise ValueError(f"a product of axes of lengths {sizes[letter]} and {size}")
    return sizes


def all_positions(shape: tuple[int, ...]) -> np.ndarray:
    """Return the position of each number of an array: 0, 1, 2 ... in its shape."""
    return np.arange(math.prod(shape)).reshape(shape)


# --- kinds of numbers ------------------------------------------------------------------------------------------------


KINDS: tuple[NumberKind, ...] = get_args(NumberKind)
"""From the narrowest to the widest."""

KIND_OF_CODE: dict[str, NumberKind] = {"b": "bool", "i": "int", "u": "int", "f": "float"}
"""Kinds by the codes of NumPy's types (`dtype.kind`)."""

ELEMENTWISE: dict[str, str] = {
    **dict.fromkeys(
        "rint sqrt exp log log1p expm1 exp2 log2 log10 cbrt sin cos tan arcsin arccos arctan sinh cosh tanh arcsinh arccosh arctanh "
        "arctan2 hypot logaddexp logaddexp2 divide".split(),
        "float",
    ),
    **dict.fromkeys(
        "abs negative sign floor ceil trunc maximum minimum fmax fmin add subtract multiply power remainder fmod "
        "floor_divide copysign".split(),
        "same",
    ),
    **dict.fromkeys("less less_equal greater greater_equal equal not_equal isnan isinf isfinite signbit".split(), "bool"),
    **dict.fromkeys("logical_and logical_or logical_xor logical_not".split(), "logical"),
    **dict.fromkeys("bitwise_and bitwise_or bitwise_xor left_shift right_shift".split(), "int"),
}  # fmt: skip
"""Operations on each number by NumPy's names, and the kind of their results: float, that of the operands ("same"), or bool.
Operands of "logical" operations become bool. Operands of "int" operations must be integers."""

_ON_BOOL = {
    **dict.fromkeys(("add", "maximum", "fmax"), "logical_or"),
    **dict.fromkeys(("multiply", "minimum", "fmin"), "logical_and"),
}
"""What NumPy makes of arithmetic on bool arrays."""


@lru_cache(1024)
def elementwise_kinds(
    op: str, kinds: tuple[NumberKind, ...], negative_exponent: bool = False
) -> tuple[str | None, NumberKind, NumberKind]:
    """Return what NumPy applies to operands of these kinds, the kind that they are cast to, and the kind of the result.

    What it applies is an operation, or None if the result is the operand.
    """
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
            return None, kind, kind
        if op in _ON_BOOL:
            op, result = _ON_BOOL[op], "logical"
        else:
            kind = "int"
    if op in ("floor", "ceil", "trunc") and kind == "int":
        return None, kind, kind
    if op in ("copysign", "isnan", "isinf", "isfinite") or (op == "power" and kind == "int" and negative_exponent):
        kind = "float"
    operands: NumberKind = "float" if result == "float" else "bool" if result == "logical" else kind
    return op, operands, "bool" if result in ("bool", "logical") else operands


def widest(kinds: Sequence[str]) -> NumberKind:
    """Return the kind that can hold numbers of all these kinds."""
    return max(KINDS, key=lambda kind: kind in kinds and KINDS.index(kind))
