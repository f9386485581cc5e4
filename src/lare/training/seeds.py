"""The seed axis: a key for each seed, and a line of metrics for each."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int, Key


@jax.jit
def seed_keys(seeds: Int[Array, " seeds"], number: int | Array) -> Key[Array, " seeds"]:
    """A key for each seed that depends on the seed and `number` alone: there is no state to save."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), number))(seeds)


State = TypeVar("State")


def of_seed(state: State, place: int = 0) -> State:
    """The part of a training state that belongs to one seed."""
    return jax.tree.map(lambda leaf: leaf[place], state)


def lines(seeds: Sequence[int], step: int, measured: Mapping[str, Any], rate: float) -> list[dict[str, Any]]:
    """One line of metrics.jsonl for each seed, of arrays that have a number for each."""
    found = []
    for place, seed in enumerate(seeds):
        numbers = {name: float(np.asarray(values)[place]) for name, values in measured.items()}
        # JSON knows no NaN: a correlation with something that never varies is null.
        known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        found.append({"step": step, "seed": seed, **known, "time/steps_per_second": round(rate, 1)})
    return found
