"""Builds a graph. The kind, the shape and the size of a result are known, and limited, before any number is computed.

An operation on constants alone is computed at once, in float64.
"""

import math
import string
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from lare_rl.phi.evaluate import compute
from lare_rl.phi.graph import (
    KIND_OF_CODE,
    Gather,
    Graph,
    Node,
    NumberKind,
    all_positions,
    elementwise_kinds,
    letter_sizes,
    widest,
)
from lare_rl.phi.limits import DEFAULT_LIMITS, MAX_EINSUM_LETTERS, OPERATION_COST, GraphLimits, RefusedError

__all__ = ["Builder", "building", "current_builder"]

ROW_OPS = {
    "row_number": "a factor cannot depend on the number of its row in the batch",
    "first_row": "x[0] of the batch takes one row for all: write x[:, i] for entry i of every row",
}
"""Values that a program may have, but not compute with: `np.arange(batch)` may be an index, and x[0] has a shape."""
_DTYPES: dict[NumberKind, type] = {"bool": bool, "int": np.int64, "float": np.float64}


class Builder:
    """Builds a graph. Each method adds an operation and returns its index. Equal operations are added once."""

    def __init__(self, limits: GraphLimits = DEFAULT_LIMITS):
        self.limits = limits
        self.nodes: list[Node] = []
        self.line = 0
        """Line of the source that is being read."""
        self.work: Counter[int] = Counter()
        """Work of each line."""
        self._depths: list[int] = []
        self._indices: dict[Any, int] = {}
        self._operations = 0

    def add(self, op: str, inputs: Sequence[int], shape: tuple[int, ...], kind: NumberKind, option: Any = None) -> int:
        """Add an operation, after its size has been checked.

        Raises:
            RefusedError: a limit would be exceeded, or a result would depend on the row's number in the batch.
        """
        self.spend(self.check_size(shape))
        nodes = [self.nodes[i] for i in inputs]
        for node in nodes:
            if node.op in ROW_OPS:
                raise RefusedError("E-ROWS", ROW_OPS[node.op])
        if nodes and all(node.op == "constant" for node in nodes):
            with np.errstate(all="ignore"):
                node = Node(op, tuple(inputs), shape, kind, option)
                return self.constant(compute(node, [constant.option for constant in nodes], ()))
        key = op, tuple(inputs), shape, kind, option.tobytes() if isinstance(option, np.ndarray) else option
        if key not in self._indices:
            depth = 1 + max((self._depths[i] for i in inputs), default=-1)
            self._operations += bool(inputs)
            if self._operations > self.limits.operations or depth > self.limits.depth:
                most = f"{self.limits.operations} operations, {self.limits.depth} of them one after the other"
                lines = _largest_lines(Counter(node.line for node in self.nodes if node.inputs))
                raise RefusedError("E-COST", f"the program has too many operations: at most {most}; {lines}")
            self._indices[key] = len(self.nodes)
            self._depths.append(depth)
            self.nodes.append(Node(op, tuple(inputs), shape, kind, option, self.line))
        return self._indices[key]

    def check_size(self, shape: Sequence[int]) -> int:
        """Return how many numbers an array of this shape has.

        Raises:
            RefusedError: it has none, or too many, or too many axes.
        """
        if len(shape) > self.limits.axes:
            raise RefusedError("E-COST", f"an array of {len(shape)} axes: at most {self.limits.axes} are available")
        size = math.prod(shape)
        if size > self.limits.array:
            most = f"at most {self.limits.array} for each row"
            raise RefusedError("E-COST", f"an array of {size} numbers is too large: {most}")
        if size <= 0:
            raise RefusedError("E-INDEX", "an array is empty: a slice may lie beyond the end of its axis")
        return size

    def spend(self, numbers: int) -> None:
        """Count the work of an operation. The limit lets every program be read within about a second."""
        self.work[self.line] += OPERATION_COST + numbers
        if self.work.total() > self.limits.work:
            most = f"at most {self.limits.work}; {_largest_lines(self.work)}"
            raise RefusedError("E-COST", f"the program computes too many numbers for each row: {most}")

    def input(self, name: str, shape: tuple[int, ...], kind: NumberKind = "float") -> int:
        """Add an array of the caller."""
        return self.add("input", (), shape, kind, name)

    def constant(self, value: Any) -> int:
        """Add numbers that never change."""
        array = np.asarray(value)
        kind = KIND_OF_CODE.get(array.dtype.kind)
        if kind is None:
            raise RefusedError("E-PYTHON", f"an array of {array.dtype}: only real numbers are available")
        return self.add("constant", (), array.shape, kind, np.array(array, _DTYPES[kind], order="C"))

    def is_constant(self, x: int) -> bool:
        return self.nodes[x].op == "constant"

    # --- operations on each number --------------------------------------------------------------------------------------

    def elementwise(self, op: str, *inputs: int) -> int:
        """Add an operation on each number, with NumPy's rules for kinds. Shapes are broadcast."""
        negative = op == "power" and self.is_constant(inputs[1]) and bool((self.nodes[inputs[1]].option < 0).any())
        kinds = tuple(self.nodes[i].kind for i in inputs)
        typed_op, operand_kind, result_kind = elementwise_kinds(op, kinds, negative)
        if typed_op is None:
            return inputs[0]
        return self._broadcast(typed_op, [self.cast(i, operand_kind) for i in inputs], result_kind)

    def where(self, condition: int, x: int, y: int) -> int:
        kind = widest([self.nodes[x].kind, self.nodes[y].kind])
        return self._broadcast("where", [self.cast(condition, "bool"), self.cast(x, kind), self.cast(y, kind)], kind)

    def _broadcast(self, op: str, inputs: Sequence[int], kind: NumberKind) -> int:
        """Add an operation. Arrays get axes of length 1 in front, so that batch axes fit in front of all of them."""
        shapes = [self.nodes[i].shape for i in inputs]
        rank = max(map(len, shapes))
        nodes = [
            i if self.is_constant(i) else self.reshape(i, (1,) * (rank - len(shape)) + shape)
            for i, shape in zip(inputs, shapes, strict=True)
        ]
        return self.add(op, nodes, np.broadcast_shapes(*(self.nodes[i].shape for i in nodes)), kind)

    def cast(self, x: int, kind: NumberKind) -> int:
        return x if self.nodes[x].kind == kind else self.add("cast", [x], self.nodes[x].shape, kind)

    # --- along axes -----------------------------------------------------------------------------------------------------

    def reduce(self, op: str, x: int, axes: tuple[int, ...]) -> int:
        """Add sum, prod, max, min, any or all over axes, counted from the front, or argmax or argmin over one axis."""
        node = self.nodes[x]
        kind = node.kind
        if op in ("any", "all"):
            x, kind = self.cast(x, "bool"), "bool"
        elif op in ("argmax", "argmin"):
            kind = "int"
        elif kind == "bool" and op in ("sum", "prod"):
            x, kind = self.cast(x, "int"), "int"
        self.spend(math.prod(node.shape))
        if not axes:  # ONNX would reduce all axes
            return x
        shape = tuple(size for axis, size in enumerate(node.shape) if axis not in axes)
        axes_from_end = tuple(axis - len(node.shape) for axis in axes)
        return self.add(op, [x], shape, kind, axes_from_end[0] if op.startswith("arg") else axes_from_end)

    def scan(self, op: str, x: int, axis: int) -> int:
        """Add cumsum, cumprod, sort or argsort along an axis."""
        node = self.nodes[x]
        kind: NumberKind = "int" if op == "argsort" or (node.kind == "bool" and op != "sort") else node.kind
        x = x if op == "argsort" else self.cast(x, kind)
        return self.add(op, [x], node.shape, kind, axis - len(node.shape))

    # --- rearrangements -------------------------------------------------------------------------------------------------

    def reshape(self, x: int, shape: tuple[int, ...]) -> int:
        return self.gather(x, all_positions(shape))

    def gather(self, x: int, positions: np.ndarray) -> int:
        """Add an array of the numbers at fixed positions of another. Rearrangements of rearrangements are one `gather`."""
        node = self.nodes[x]
        self.spend(positions.size)
        if node.op in ROW_OPS:
            return self.add(node.op, (), positions.shape, node.kind)
        if node.op == "constant":
            self.check_size(positions.shape)
            return self.constant(node.option.reshape(-1)[positions])
        if positions.shape == node.shape and np.array_equal(positions, all_positions(node.shape)):
            return x
        if node.op == "gather":
            return self.gather(node.inputs[0], np.asarray(node.option.reshape(-1)[positions]))
        if node.op == "concat":  # read a single source directly
            ends = np.cumsum([self.nodes[i].shape[0] for i in node.inputs])
            source = int(np.searchsorted(ends, positions.min(), side="right"))
            if positions.max() < ends[source]:
                return self.gather(node.inputs[source], np.asarray(positions - (ends[source - 1] if source else 0)))
        return self.add("gather", [x], positions.shape, node.kind, np.ascontiguousarray(positions))

    def concat(self, inputs: Sequence[int]) -> int:
        """Add all numbers of several arrays, one after the other."""
        kind = widest([self.nodes[i].kind for i in inputs])
        flat = [self.flatten(self.cast(i, kind)) for i in inputs]
        if len(flat) == 1:
            return flat[0]
        return self.add("concat", flat, (sum(self.nodes[i].shape[0] for i in flat),), kind)

    def flatten(self, x: int) -> int:
        return self.reshape(x, (math.prod(self.nodes[x].shape),))

    def take(self, x: int, positions: int) -> int:
        """Add the numbers at computed positions of an array. A position beyond an end stands for the last number."""
        if self.is_constant(positions):
            return self.gather(x, self.nodes[positions].option)
        return self.add("take", [self.flatten(x), positions], self.nodes[positions].shape, self.nodes[x].kind)

    # --- products -------------------------------------------------------------------------------------------------------

    def einsum(self, terms: Sequence[str], result: str, inputs: Sequence[int]) -> int:
        """Add `numpy.einsum`, with a letter for each axis of a row."""
        sizes = letter_sizes(terms, [self.nodes[i].shape for i in inputs])
        if len(sizes) > MAX_EINSUM_LETTERS:
            raise RefusedError("E-COST", f"np.einsum with more than {MAX_EINSUM_LETTERS} letters")
        n_products = math.prod(sizes.values())
        self.check_size([n_products])
        self.spend(n_products)
        # The letters become a, b, c ..., so that equal products are equal nodes and other letters are free.
        letters = dict(zip(sizes, string.ascii_letters, strict=False))
        terms = ["".join(letters[c] for c in term) for term in terms]
        pattern = ",".join("..." + term for term in terms) + "->..." + "".join(letters[c] for c in result)
        kind = widest([self.nodes[i].kind for i in inputs] + ["int"])
        return self.add("einsum", [self.cast(i, kind) for i in inputs], tuple(sizes[c] for c in result), kind, pattern)

    def det(self, x: int) -> int:
        shape = self.nodes[x].shape
        self.spend(math.prod(shape) * shape[-1])
        return self.add("det", [self.cast(x, "float")], shape[:-2], "float")

    # --- the graph ------------------------------------------------------------------------------------------------------

    def finish(self, outputs: Mapping[str, int]) -> Graph:
        """Return the graph of these outputs: all inputs, and the operations that are needed."""
        needed = {i for i, node in enumerate(self.nodes) if node.op == "input"} | set(outputs.values())
        for i in range(len(self.nodes) - 1, -1, -1):
            if i in needed:
                needed.update(self.nodes[i].inputs)
        new_index = {old: new for new, old in enumerate(sorted(needed))}
        nodes: list[Node] = []
        for old in new_index:
            node, inputs = self.nodes[old], tuple(new_index[i] for i in self.nodes[old].inputs)
            if node.op in ROW_OPS:
                raise RefusedError("E-ROWS", ROW_OPS[node.op])
            option = _find_box(node.option, nodes[inputs[0]].shape) if node.op == "gather" else node.option
            nodes.append(node._replace(inputs=inputs, option=option))
        graph = Graph(tuple(nodes), {name: new_index[i] for name, i in outputs.items()})
        if graph.size > self.limits.numbers:
            numbers: Counter[int] = Counter()
            for node in graph.operations:
                numbers[node.line] += graph.cost(node)
            most = f"at most {self.limits.numbers} are accepted; {_largest_lines(numbers)}"
            raise RefusedError("E-COST", f"the factors need {graph.size} numbers for each row: {most}")
        return graph


def _largest_lines(costs: Counter[int]) -> str:
    """Name the lines of a program that cost most."""
    return "most in " + ", ".join(f"line {line} ({cost})" for line, cost in costs.most_common(3))


def _find_box(positions: np.ndarray, shape: tuple[int, ...]) -> Gather:
    """Return the option of a `gather` from an array of this shape, with slices if its positions form a box."""
    flat = positions.reshape(-1)
    if np.array_equal(flat, np.arange(math.prod(shape))):
        return Gather(positions, tuple(slice(0, size, 1) for size in shape))
    slices = []
    for coordinates in np.unravel_index(flat, shape) if shape else ():
        values = np.unique(coordinates)
        step = int(values[1] - values[0]) if len(values) > 1 else 1
        slices.append(slice(int(values[0]), int(values[-1]) + 1, step))
    box = all_positions(shape)[tuple(slices)].reshape(-1)
    return Gather(positions, tuple(slices) if np.array_equal(box, flat) else None)


_BUILDING: ContextVar[Builder] = ContextVar("_BUILDING")


@contextmanager
def building(builder: Builder) -> Iterator[Builder]:
    """Let `current_builder` return this builder."""
    token = _BUILDING.set(builder)
    try:
        yield builder
    finally:
        _BUILDING.reset(token)


current_builder: Callable[[], Builder] = _BUILDING.get
"""Returns the builder of the graph that is being read."""
