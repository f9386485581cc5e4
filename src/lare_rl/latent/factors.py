"""Compute the factors of steps with NumPy. Factors that are not finite are an error."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lare_rl.errors import LareError
from lare_rl.phi.evaluate import compute, evaluate
from lare_rl.phi.graph import Graph

__all__ = ["LatentRewardError", "check_finite", "compute_factors", "find_infinity"]

_CHUNK_NUMBERS = 1 << 22
"""About how many numbers are computed at a time."""


class LatentRewardError(LareError):
    """A factor is not finite. `observation` and `action` are the batch for which it was computed."""

    def __init__(self, message: str, observation: np.ndarray, action: np.ndarray):
        super().__init__(message)
        self.observation, self.action = observation, action


def compute_factors(
    graph: Graph, observation: Float[np.ndarray, "batch observation"], action: Float[np.ndarray, "batch action"]
) -> Float[np.ndarray, "batch factors"]:
    """Compute the factors of a batch. They are not checked: they may be infinite or NaN."""
    rows = max(1, _CHUNK_NUMBERS // max(graph.size, 1))
    chunks = [
        evaluate(graph, {"observation": observation[i : i + rows], "action": action[i : i + rows]})["factors"]
        for i in range(0, max(len(observation), 1), rows)
    ]
    return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)


def check_finite(
    factors: Float[np.ndarray, "batch factors"],
    names: Sequence[str],
    observation: Float[np.ndarray, "batch observation"],
    action: Float[np.ndarray, "batch action"],
) -> None:
    """Check that all factors are finite. Raises `LatentRewardError` if a factor is infinite or NaN."""
    if not np.isfinite(factors).all():
        row, column = np.argwhere(~np.isfinite(factors))[0]
        text = np.array2string(observation[row], precision=3, threshold=6)
        message = (
            f"the latent function failed: factor {names[column]!r} is {factors[row, column]} for the observation {text}"
        )
        raise LatentRewardError(message, observation, action)


def find_infinity(
    graph: Graph,
    factor: int,
    observation: Float[np.ndarray, "batch observation"],
    action: Float[np.ndarray, "batch action"],
) -> tuple[str, int] | None:
    """Return the first operation that makes a factor infinite or NaN on these rows, and its line in the source, or None."""
    values: list[np.ndarray] = []
    finite: list[bool] = []
    inputs = {"observation": observation, "action": action}
    for node in graph.nodes:
        if node.op == "input":
            values.append(inputs[node.option])
        elif node.op == "constant":
            values.append(node.option)
        else:
            with np.errstate(all="ignore"):
                values.append(compute(node, [values[i] for i in node.inputs], (len(observation),), dtype=np.float32))
        finite.append(bool(np.isfinite(values[-1]).all()))
    needed = graph.needed_for("factors", factor)
    for i, node in enumerate(graph.nodes):
        if i in needed and node.inputs and not finite[i] and all(finite[j] for j in node.inputs):
            return node.op, node.line
    return None
