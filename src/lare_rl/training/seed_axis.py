"""The seed axis: the part of a state that belongs to one seed, and a line of metrics for each."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int

State = TypeVar("State")


@jax.jit
def of_seed(state: State, place: int | Int[Array, ""] = 0) -> State:
    """The part of a training state that belongs to one seed."""
    return jax.tree.map(lambda leaf: leaf[place], state)


def lines(seeds: Sequence[int], step: int, measured: Mapping[str, Any], rate: float) -> list[dict[str, Any]]:
    """One line of metrics.jsonl for each seed, from arrays with one number for each seed."""
    found = []
    for place, seed in enumerate(seeds):
        numbers = {name: float(np.asarray(values)[place]) for name, values in measured.items()}
        # JSON has no NaN: a correlation with a value that never varies is null.
        known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        found.append({"step": step, "seed": seed, **known, "time/steps_per_second": round(rate, 1)})
    return found
