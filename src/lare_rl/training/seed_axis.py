"""The seed axis: the part of a state that belongs to one seed, and a line of metrics for each."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int

__all__ = ["metrics_lines", "select_seed"]

State = TypeVar("State")


@jax.jit
def select_seed(state: State, seed_index: int | Int[Array, ""] = 0) -> State:
    """Return the part of a training state that belongs to one seed."""
    return jax.tree.map(lambda leaf: leaf[seed_index], state)


def metrics_lines(seeds: Sequence[int], step: int, metrics: Mapping[str, Any], rate: float) -> list[dict[str, Any]]:
    """Return one line of metrics.jsonl for each seed.

    Args:
        seeds: the seeds of the run.
        step: the environment steps of each seed.
        metrics: arrays with one number for each seed.
        rate: steps per second.
    """
    lines = []
    for seed_index, seed in enumerate(seeds):
        numbers = {name: float(np.asarray(values)[seed_index]) for name, values in metrics.items()}
        # JSON has no NaN: a correlation with a value that never varies is null.
        valid = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        lines.append({"step": step, "seed": seed, **valid, "time/steps_per_second": round(rate, 1)})
    return lines
