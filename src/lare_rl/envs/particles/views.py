"""An agent's view of other entities: their relative positions, nearest first."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["concatenate_rows", "distances", "nearest_entities", "nearest_positions", "relative_positions", "slice_rows"]

Positions = Float[Array, "entities 2"]


def distances(position: Positions, observers: range, targets: range) -> Float[Array, "observers targets"]:
    """Return the distances between the centres of observers and targets; infinite from an entity to itself."""
    offset = slice_rows(position, targets) - slice_rows(position, observers)[:, None]
    is_same = np.asarray(observers)[:, None] == np.asarray(targets)
    return jnp.where(is_same, jnp.inf, jnp.sqrt(jnp.sum(offset**2, axis=-1)))


def nearest_entities(
    position: Positions, observers: range, targets: range, count: int
) -> Int[Array, "observers count"]:
    """Return the indices of the `count` targets that are nearest to each observer, nearest first."""
    _, index = jax.lax.top_k(-distances(position, observers, targets), count)
    return targets.start + index


def relative_positions(
    position: Positions, observers: range, entities: Int[Array, "observers count"]
) -> Float[Array, "observers count 2"]:
    return position[entities] - slice_rows(position, observers)[:, None]


def nearest_positions(
    position: Positions, observers: range, targets: range, count: int
) -> Float[Array, "observers count 2"]:
    """Return the relative positions of the `count` nearest targets."""
    return relative_positions(position, observers, nearest_entities(position, observers, targets, count))


def slice_rows(values: Float[Array, "entities 2"], entities: range) -> Float[Array, "range 2"]:
    return values[entities.start : entities.stop]


def concatenate_rows(*arrays: Float[Array, "observers ..."]) -> Float[Array, "observers observation"]:
    """Flatten each array to a row for each observer, and concatenate the rows."""
    return jnp.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
