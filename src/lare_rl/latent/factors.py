"""Compute the factors of steps with NumPy. Factors that are not finite are an error."""

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError
from lare_rl.phi.evaluate import compute_nodes, evaluate
from lare_rl.phi.graph import Graph

__all__ = ["NonFiniteFactorError", "compute_batch", "find_nonfinite_operation"]

_CHUNK_NUMBERS = 1 << 22
"""About how many values of the graph are in memory at a time."""


class NonFiniteFactorError(LareError):
    """A factor is not finite. `observation` and `action` are the batch for which it was computed."""

    def __init__(self, message: str, observation: np.ndarray, action: np.ndarray):
        super().__init__(message, observation, action)  # so that a process can send it to another
        self.observation, self.action = observation, action

    def __str__(self) -> str:
        return self.args[0]


def compute_batch(
    graph: Graph, observation: Float[np.ndarray, "batch observation"], action: Float[np.ndarray, "batch action"]
) -> Float[np.ndarray, "batch factors"]:
    """Compute the factors of a batch. They are not checked: they may be infinite or NaN."""
    rows = max(1, _CHUNK_NUMBERS // max(graph.size, 1))
    chunks = [
        evaluate(graph, {"observation": observation[i : i + rows], "action": action[i : i + rows]})["factors"]
        for i in range(0, max(len(observation), 1), rows)
    ]
    return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)


def find_nonfinite_operation(
    graph: Graph,
    factor: int,
    observation: Float[np.ndarray, "batch observation"],
    action: Float[np.ndarray, "batch action"],
) -> tuple[str, int] | None:
    """Return the first operation that makes a factor infinite or NaN on these rows, and its line in the source. None if none does."""
    values = compute_nodes(graph, {"observation": observation, "action": action}, keep=True)
    finite = [bool(np.isfinite(value).all()) for value in values]
    needed = graph.needed_for("factors", factor)
    for i, node in enumerate(graph.nodes):
        if i in needed and node.inputs and not finite[i] and all(finite[j] for j in node.inputs):
            return node.op, node.line
    return None
