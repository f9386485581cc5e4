"""A function of ONE row, as a list of typed array operations.

The shapes of a graph say nothing of a batch, and no operation can reach another row: rows are independent because nothing else can
be written. `evaluate` computes any number of rows by giving every array batch axes in front. The kind and the shape of every result
are known, and bounded, before any number is computed. An operation on constants alone is computed at once, in float64.

    bool, int, float      the kinds of numbers; float32, int32 and bool when a graph is computed
    input, constant       arrays that the caller gives, and arrays that never change
    `ELEMENTWISE`, where, cast                                        on each number
    sum, prod, max, min, any, all, argmax, argmin                     along axes
    cumsum, cumprod, sort, argsort                                    along one axis
    einsum, det                                                       products
    gather        numbers at fixed positions: every slice, reshape, transpose, flip, repetition
    take          numbers at computed positions of an array with one axis
    concat        arrays with one axis, one after the other
"""

import math
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from lare_rl.phi.evaluate import compute

Kind = Literal["bool", "int", "float"]
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
"""Operations on each number, by NumPy's names, and the kind of their results: float, that of the operands, or bool. Operands of
"logical" operations are made bool, and those of "int" operations must be integers."""

_ON_BOOL = {"add": "logical_or", "maximum": "logical_or", "multiply": "logical_and", "minimum": "logical_and"}
"""What NumPy makes of arithmetic on bool arrays."""


ROW_OPS = {
    "row_number": "a factor cannot depend on the number of its row in the batch",
    "first_row": "x[0] of the batch takes one row for all: write x[:, i] for entry i of every row",
}
"""Values that a program may have, but not compute with: `np.arange(batch)` may be an index, and x[0] has a shape."""


class Refused(Exception):
    """A program that is not accepted. The message tells its author what to change; `code` names the rule."""

    def __init__(self, code: str, message: str, line: int | None = None):
        super().__init__(message)
        self.code, self.line = code, line


@dataclass(frozen=True)
class Limits:
    """Bounds on a graph. They bound the time and the memory of everything that is computed from it."""

    array: int = 1 << 16
    """The most numbers of one array, for each row."""
    axes: int = 16
    operations: int = 1000
    chain: int = 400
    """The most operations that need each other's results."""
    numbers: int = 1 << 15
    """The most numbers of all results of a finished graph together, for each row."""
    work: int = 1 << 21
    """The most numbers that are computed while a graph is built, for each row; each operation counts as `OPERATION_COST` more."""


OPERATION_COST = 200
UNLIMITED = Limits(*[2**62] * 6)
"""For graphs that LaRe itself builds."""


class Node(NamedTuple):
    """An operation and its result. `inputs` are indices of earlier nodes."""

    op: str
    inputs: tuple[int, ...]
    shape: tuple[int, ...]
    """The shape of the result, for one row."""
    kind: Kind
    option: Any = None
    """What else the operation needs: axes, positions, a pattern, the name of an input, the numbers of a constant."""
    line: int = 0
    """The line of the source that it was read from."""


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
    def factor_count(self) -> int:
        """The length of the output "factors" of a graph that was read."""
        return self.nodes[self.outputs["factors"]].shape[0]

    @property
    def operations(self) -> list[Node]:
        return [node for node in self.nodes if node.op not in ("input", "constant")]

    @property
    def size(self) -> int:
        """How many numbers its operations compute for each row; products of arrays count all their terms."""
        return sum(self._cost(node) for node in self.operations)

    def _cost(self, node: Node) -> int:
        if node.op != "einsum":
            return math.prod(node.shape)
        terms = node.option.partition("->")[0].replace("...", "").split(",")
        return math.prod(_letter_sizes(terms, [self.nodes[i].shape for i in node.inputs]).values())

    @property
    def depth(self) -> int:
        """The most operations that need each other's results."""
        depths: list[int] = []
        for node in self.nodes:
            depths.append(max((depths[i] for i in node.inputs), default=-1) + 1)
        return max(depths, default=0)

    def entries_read(self, output: str) -> list[dict[str, list[int]]]:
        """For each number of an output, the entries of each input that it depends on."""
        inputs = [(i, node.option) for i, node in enumerate(self.nodes) if node.op == "input"]
        entries = []
        for number in range(math.prod(self.nodes[self.outputs[output]].shape)):
            needed = self.needed_for(output, number)
            entries.append({name: np.flatnonzero(needed[i]).tolist() if i in needed else [] for i, name in inputs})
        return entries

    def needed_for(self, output: str, number: int) -> dict[int, np.ndarray]:
        """The nodes that a number of an output depends on, and for each a mask of the numbers that it depends on."""
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
    """Which numbers of an operation's inputs its needed numbers depend on."""
    masks = [np.zeros(shape, bool) for shape in shapes]
    match node.op:
        case "gather":
            masks[0].reshape(-1)[node.option.positions[needed]] = True
        case "concat":
            masks = list(np.split(needed, np.cumsum([shape[0] for shape in shapes])[:-1]))
        case "take":
            masks = [np.ones(shapes[0], bool), _broadcast_back(needed, shapes[1])]
        case "einsum" | "det":
            masks = [np.ones(shape, bool) for shape in shapes]
        case "sum" | "prod" | "max" | "min" | "any" | "all" | "argmax" | "argmin":
            masks[0] |= np.expand_dims(needed, node.option)
        case "cumsum" | "cumprod" | "sort" | "argsort":
            masks[0] |= needed.any(node.option, keepdims=True)
        case _:
            masks = [_broadcast_back(needed, shape) for shape in shapes]
    return masks


def _broadcast_back(needed: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which numbers of an array are needed, if it was broadcast to the shape of `needed`."""
    padded = (1,) * (needed.ndim - len(shape)) + shape
    axes = tuple(axis for axis, size in enumerate(padded) if size == 1)
    return np.asarray(needed.any(axes, keepdims=True)).reshape(shape)


class Builder:
    """Builds a graph. Each method adds an operation and returns its index. Equal operations are added once."""

    def __init__(self, limits: Limits = Limits()):
        self.limits = limits
        self.nodes: list[Node] = []
        self.line = 0
        """The line of the source that is being read."""
        self.work = 0
        self._chains: list[int] = []
        self._indices: dict[Any, int] = {}
        self._operations = 0

    def add(self, op: str, inputs: Sequence[int], shape: tuple[int, ...], kind: Kind, option: Any = None) -> int:
        """Add an operation, after its size has been checked.

        Raises:
            Refused: a limit would be exceeded, or a result would depend on the row's number in the batch.
        """
        self.spend(self.check_size(shape))
        nodes = [self.nodes[i] for i in inputs]
        for node in nodes:
            if node.op in ROW_OPS:
                raise Refused("E-ROWS", ROW_OPS[node.op])
        if nodes and all(node.op == "constant" for node in nodes):
            return self.constant(_fold(Node(op, tuple(inputs), shape, kind, option), [node.option for node in nodes]))
        key = op, tuple(inputs), shape, kind, option.tobytes() if isinstance(option, np.ndarray) else option
        if key not in self._indices:
            chain = 1 + max((self._chains[i] for i in inputs), default=-1)
            self._operations += bool(inputs)
            if self._operations > self.limits.operations or chain > self.limits.chain:
                most = f"{self.limits.operations} operations, {self.limits.chain} of them one after the other"
                raise Refused("E-COST", f"the program has too many operations: at most {most}")
            self._indices[key] = len(self.nodes)
            self._chains.append(chain)
            self.nodes.append(Node(op, tuple(inputs), shape, kind, option, self.line))
        return self._indices[key]

    def check_size(self, shape: Sequence[int]) -> int:
        """Return how many numbers an array of this shape has. Raises `Refused` for none, or for too many numbers or axes."""
        if len(shape) > self.limits.axes:
            raise Refused("E-COST", f"an array of {len(shape)} axes: at most {self.limits.axes} are available")
        size = math.prod(shape)
        if size > self.limits.array:
            raise Refused(
                "E-COST", f"an array of {size} numbers is too large: at most {self.limits.array} for each row"
            )
        if size <= 0:
            raise Refused("E-INDEX", "an array is empty: a slice may lie beyond the end of its axis")
        return size

    def spend(self, numbers: int) -> None:
        """Count work, so that every program is read within a second or so."""
        self.work += OPERATION_COST + numbers
        if self.work > self.limits.work:
            raise Refused("E-COST", "the program computes too much for one row")

    def input(self, name: str, shape: tuple[int, ...], kind: Kind = "float") -> int:
        """An array that the caller gives."""
        return self.add("input", (), shape, kind, name)

    def constant(self, value: Any) -> int:
        """Numbers that never change."""
        array = np.asarray(value)
        kinds: dict[str, Kind] = {"b": "bool", "i": "int", "u": "int", "f": "float"}
        if array.dtype.kind not in kinds:
            raise Refused("E-PYTHON", f"an array of {array.dtype}: only real numbers and truth values are available")
        kind = kinds[array.dtype.kind]
        array = np.array(array, {"bool": bool, "int": np.int64, "float": np.float64}[kind], order="C")
        return self.add("constant", (), array.shape, kind, array)

    def is_constant(self, x: int) -> bool:
        return self.nodes[x].op == "constant"

    # --- operations on each number --------------------------------------------------------------------------------------

    def elementwise(self, op: str, *inputs: int) -> int:
        """An operation on each number, with NumPy's rules for kinds. Shapes are broadcast."""
        result = ELEMENTWISE[op]
        kinds = [self.nodes[i].kind for i in inputs]
        kind = widest(kinds)
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
                return inputs[0]
            if op in _ON_BOOL:
                op, result = _ON_BOOL[op], "logical"
            else:
                kind = "int"
        if op in ("floor", "ceil", "trunc", "rint") and kind == "int":
            return inputs[0]
        if op == "copysign" or (op == "power" and kind == "int" and self._has_negative(inputs[1])):
            kind = "float"
        operand_kind: Kind = "float" if result == "float" else "bool" if result == "logical" else kind
        nodes = self._same_rank([self.cast(i, operand_kind) for i in inputs])
        shape = np.broadcast_shapes(*(self.nodes[i].shape for i in nodes))
        return self.add(op, nodes, shape, "bool" if result in ("bool", "logical") else operand_kind)

    def _has_negative(self, exponent: int) -> bool:
        return self.is_constant(exponent) and bool((self.nodes[exponent].option < 0).any())

    def where(self, condition: int, yes: int, no: int) -> int:
        kind = widest([self.nodes[i].kind for i in (yes, no)])
        nodes = self._same_rank([self.cast(condition, "bool"), self.cast(yes, kind), self.cast(no, kind)])
        return self.add("where", nodes, np.broadcast_shapes(*(self.nodes[i].shape for i in nodes)), kind)

    def _same_rank(self, inputs: Sequence[int]) -> list[int]:
        """The arrays with axes of length 1 in front, so that batch axes fit in front of all of them."""
        rank = max(len(self.nodes[i].shape) for i in inputs)
        return [
            i
            if self.is_constant(i)
            else self.reshape(i, (1,) * (rank - len(self.nodes[i].shape)) + self.nodes[i].shape)
            for i in inputs
        ]

    def cast(self, x: int, kind: Kind) -> int:
        return x if self.nodes[x].kind == kind else self.add("cast", [x], self.nodes[x].shape, kind)

    # --- along axes -----------------------------------------------------------------------------------------------------

    def reduce(self, op: str, x: int, axes: tuple[int, ...]) -> int:
        """sum, prod, max, min, any or all over axes, counted from the front; argmax or argmin over one axis."""
        node = self.nodes[x]
        kind = node.kind
        if op in ("any", "all"):
            x, kind = self.cast(x, "bool"), "bool"
        elif op in ("argmax", "argmin"):
            kind = "int"
        elif kind == "bool" and op in ("sum", "prod"):
            x, kind = self.cast(x, "int"), "int"
        self.spend(math.prod(node.shape))
        shape = tuple(size for axis, size in enumerate(node.shape) if axis not in axes)
        from_end = tuple(axis - len(node.shape) for axis in axes)
        return self.add(op, [x], shape, kind, from_end[0] if op.startswith("arg") else from_end)

    def scan(self, op: str, x: int, axis: int) -> int:
        """cumsum, cumprod, sort or argsort along an axis."""
        node = self.nodes[x]
        kind: Kind = "int" if op == "argsort" or (node.kind == "bool" and op != "sort") else node.kind
        x = x if op == "argsort" else self.cast(x, kind)
        return self.add(op, [x], node.shape, kind, axis - len(node.shape))

    # --- rearrangements -------------------------------------------------------------------------------------------------

    def reshape(self, x: int, shape: tuple[int, ...]) -> int:
        return self.gather(x, all_positions(shape))

    def gather(self, x: int, positions: np.ndarray) -> int:
        """An array of the numbers at fixed positions of another."""
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
            return self.gather(node.inputs[0], node.option.reshape(-1)[positions])
        if node.op == "concat":
            ends = np.cumsum([self.nodes[i].shape[0] for i in node.inputs])
            source = int(np.searchsorted(ends, positions.min(), side="right"))
            if positions.max() < ends[source]:
                return self.gather(node.inputs[source], positions - (ends[source - 1] if source else 0))
        return self.add("gather", [x], positions.shape, node.kind, np.ascontiguousarray(positions))

    def concat(self, inputs: Sequence[int]) -> int:
        """All numbers of several arrays, one after the other."""
        kind = widest([self.nodes[i].kind for i in inputs])
        flat = [self.flatten(self.cast(i, kind)) for i in inputs]
        if len(flat) == 1:
            return flat[0]
        return self.add("concat", flat, (sum(self.nodes[i].shape[0] for i in flat),), kind)

    def flatten(self, x: int) -> int:
        return self.reshape(x, (math.prod(self.nodes[x].shape),))

    def take(self, x: int, positions: int) -> int:
        """The numbers at computed positions of an array. A position beyond an end stands for the last number."""
        if self.is_constant(positions):
            return self.gather(x, self.nodes[positions].option)
        return self.add("take", [self.flatten(x), positions], self.nodes[positions].shape, self.nodes[x].kind)

    # --- products -------------------------------------------------------------------------------------------------------

    def einsum(self, terms: Sequence[str], result: str, inputs: Sequence[int]) -> int:
        """`numpy.einsum`, with a letter for each axis of a row."""
        sizes = _letter_sizes(terms, [self.nodes[i].shape for i in inputs])
        if len(sizes) > 20:
            raise Refused("E-COST", "np.einsum with more than 20 letters")
        terms_computed = math.prod(sizes.values())
        self.check_size([terms_computed])
        self.spend(terms_computed)
        letters = dict(zip(sizes, string.ascii_letters, strict=False))  # a, b, c ..., so that others are free
        terms, result = ["".join(letters[c] for c in term) for term in terms], "".join(letters[c] for c in result)
        sizes = {letters[c]: size for c, size in sizes.items()}
        kind = widest([self.nodes[i].kind for i in inputs] + ["int"])
        pattern = ",".join("..." + term for term in terms) + "->..." + result
        shape = tuple(sizes[letter] for letter in result)
        return self.add("einsum", [self.cast(i, kind) for i in inputs], shape, kind, pattern)

    def det(self, x: int) -> int:
        shape = self.nodes[x].shape
        self.spend(math.prod(shape) * shape[-1])
        return self.add("det", [self.cast(x, "float")], shape[:-2], "float")

    # --- whole graphs ---------------------------------------------------------------------------------------------------

    def finish(self, outputs: Mapping[str, int]) -> Graph:
        """The graph of these outputs: all inputs, and the operations that are needed."""
        needed = {i for i, node in enumerate(self.nodes) if node.op == "input"} | set(outputs.values())
        for i in range(len(self.nodes) - 1, -1, -1):
            if i in needed:
                needed.update(self.nodes[i].inputs)
        new_index = {old: new for new, old in enumerate(sorted(needed))}
        nodes: list[Node] = []
        for old in new_index:
            node, inputs = self.nodes[old], tuple(new_index[i] for i in self.nodes[old].inputs)
            option = _gather(node.option, nodes[inputs[0]].shape) if node.op == "gather" else node.option
            nodes.append(node._replace(inputs=inputs, option=option))
            if node.op in ROW_OPS:
                raise Refused("E-ROWS", ROW_OPS[node.op])
        graph = Graph(tuple(nodes), {name: new_index[i] for name, i in outputs.items()})
        if graph.size > self.limits.numbers:
            most = self.limits.numbers
            raise Refused("E-COST", f"the factors need {graph.size} numbers for each row: at most {most} are accepted")
        return graph

    def inline(self, graph: Graph, inputs: Mapping[str, int], rows: int | None = None) -> dict[str, int]:
        """Add all operations of another graph, and return the indices of its outputs.

        Args:
            graph: the other graph.
            inputs: for each of its inputs, a node of this graph.
            rows: if given, the nodes in `inputs` have an axis of this length in front, and so have the outputs: the graph is
                computed for each of these rows.
        """
        new: list[int] = []
        for node in graph.nodes:
            x = [new[i] for i in node.inputs]
            if node.op == "input":
                new.append(inputs[node.option])
            elif node.op == "constant":
                new.append(self.constant(node.option))
            elif rows is None:
                option = node.option.positions if node.op == "gather" else node.option
                new.append(self.add(node.op, x, node.shape, node.kind, option))
            else:
                new.append(self._add_for_rows(node, x, [graph.nodes[i] for i in node.inputs], rows))
        return {name: self._for_rows(new[i], graph.nodes[i].shape, rows) for name, i in graph.outputs.items()}

    def _add_for_rows(self, node: Node, x: list[int], inputs: Sequence[Node], rows: int) -> int:
        """An operation on arrays that have one more axis in front."""
        option, shape = node.option, (rows, *node.shape)
        if all(map(self.is_constant, x)):
            return self.add(node.op, x, node.shape, node.kind, option)
        sizes = [math.prod(operand.shape) for operand in inputs]
        starts = np.arange(rows).reshape(-1, *[1] * len(node.shape))
        match node.op:
            case "gather":
                return self.gather(x[0], starts * sizes[0] + option.positions)
            case "concat":
                ends = np.cumsum(sizes) - sizes
                x = [self._for_rows(i, operand.shape, rows) for i, operand in zip(x, inputs, strict=True)]
                columns = [
                    rows * end + np.arange(rows)[:, None] * size + np.arange(size)
                    for end, size in zip(ends, sizes, strict=True)
                ]
                return self.gather(self.concat(x), np.concatenate(columns, 1))
            case "take" if not self.is_constant(x[0]):
                return self.take(x[0], self.elementwise("add", x[1], self.constant(starts * sizes[0])))
            case "einsum":
                terms, result = option.replace("...", "").split("->")
                letter = next(c for c in string.ascii_letters if c not in terms)
                marked = [
                    term if self.is_constant(i) else letter + term for term, i in zip(terms.split(","), x, strict=True)
                ]
                return self.einsum(marked, letter + result, x)
        return self.add(node.op, x, shape, node.kind, option)

    def _for_rows(self, x: int, shape: tuple[int, ...], rows: int | None) -> int:
        """A constant, once for each row; anything else has been computed for each row."""
        if rows is None or not self.is_constant(x):
            return x
        return self.gather(x, np.broadcast_to(all_positions(shape), (rows, *shape)))


def _letter_sizes(terms: Sequence[str], shapes: Sequence[tuple[int, ...]]) -> dict[str, int]:
    """The length of the axis that each letter of an einsum stands for."""
    sizes: dict[str, int] = {}
    for term, shape in zip(terms, shapes, strict=True):
        for letter, size in zip(term, shape, strict=True):
            if sizes.setdefault(letter, size) != size:
                raise ValueError(f"a product of axes of lengths {sizes[letter]} and {size}")
    return sizes


def widest(kinds: Sequence[str]) -> Kind:
    """The kind that can hold numbers of all these kinds."""
    return max(KINDS, key=lambda kind: kind in kinds and KINDS.index(kind))


def all_positions(shape: tuple[int, ...]) -> np.ndarray:
    """The position of each number of an array."""
    return np.arange(math.prod(shape)).reshape(shape)


def _gather(positions: np.ndarray, shape: tuple[int, ...]) -> Gather:
    """The option of a `gather` from an array of this shape."""
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


def _fold(node: Node, arrays: list[np.ndarray]) -> np.ndarray:
    """The result of an operation on constants."""
    with np.errstate(all="ignore"):
        return compute(node, arrays, ())


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
"""The builder of the graph that is being read."""
