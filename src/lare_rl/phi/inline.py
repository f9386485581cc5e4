"""Puts a graph into another one: the graph of phi into the graph of a reward."""

import math
import string
from collections.abc import Mapping, Sequence

import numpy as np

from lare_rl.phi.builder import Builder
from lare_rl.phi.graph import Graph, Node, all_positions

__all__ = ["inline"]


def inline(builder: Builder, graph: Graph, inputs: Mapping[str, int], rows: int | None = None) -> dict[str, int]:
    """Add all operations of a graph to a builder, and return the nodes of its outputs.

    Args:
        builder: the builder of the outer graph.
        graph: the inner graph.
        inputs: for each input of the inner graph, a node of the outer graph.
        rows: if set, the nodes in `inputs` have an axis of this length in front, the inner graph is computed for each of these rows,
            and the outputs have this axis too.
    """
    new: list[int] = []
    for node in graph.nodes:
        x = [new[i] for i in node.inputs]
        if node.op == "input":
            new.append(inputs[node.option])
        elif node.op == "constant":
            new.append(builder.constant(node.option))
        elif rows is None:
            option = node.option.positions if node.op == "gather" else node.option
            new.append(builder.add(node.op, x, node.shape, node.kind, option))
        else:
            new.append(_add_for_rows(builder, node, x, [graph.nodes[i] for i in node.inputs], rows))
    return {name: _repeat_constant(builder, new[i], graph.nodes[i].shape, rows) for name, i in graph.outputs.items()}


def _add_for_rows(builder: Builder, node: Node, x: list[int], inputs: Sequence[Node], rows: int) -> int:
    """Add an operation on arrays that have one more axis in front."""
    if all(map(builder.is_constant, x)):
        return builder.add(node.op, x, node.shape, node.kind, node.option)
    sizes = [math.prod(operand.shape) for operand in inputs]
    starts = np.arange(rows).reshape(-1, *[1] * len(node.shape))
    match node.op:
        case "gather":
            return builder.gather(x[0], starts * sizes[0] + node.option.positions)
        case "concat":
            ends = np.cumsum(sizes) - sizes
            x = [_repeat_constant(builder, i, operand.shape, rows) for i, operand in zip(x, inputs, strict=True)]
            columns = [
                rows * end + np.arange(rows)[:, None] * size + np.arange(size)
                for end, size in zip(ends, sizes, strict=True)
            ]
            return builder.gather(builder.concat(x), np.concatenate(columns, 1))
        case "take" if not builder.is_constant(x[0]):
            return builder.take(x[0], builder.elementwise("add", x[1], builder.constant(starts * sizes[0])))
        case "einsum":
            terms, result = node.option.replace("...", "").split("->")
            letter = next(c for c in string.ascii_letters if c not in terms)
            terms = [
                ("" if builder.is_constant(i) else letter) + term for term, i in zip(terms.split(","), x, strict=True)
            ]
            return builder.einsum(terms, letter + result, x)
    return builder.add(node.op, x, (rows, *node.shape), node.kind, node.option)


def _repeat_constant(builder: Builder, x: int, shape: tuple[int, ...], rows: int | None) -> int:
    """Repeat a constant for each row. Anything else has been computed for each row."""
    if rows is None or not builder.is_constant(x):
        return x
    return builder.gather(x, np.broadcast_to(all_positions(shape), (rows, *shape)))
