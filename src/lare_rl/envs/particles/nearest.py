"""An agent's view of other entities: their relative positions, nearest first."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def distances(
    position: Float[Array, "entities 2"], observers: range, others: range
) -> Float[Array, "observers others"]:
    """The distances between the centres of observers and other entities; infinite from an entity to itself."""
    offset = span(position, others) - span(position, observers)[:, None]
    return jnp.where(same(observers, others), jnp.inf, jnp.sqrt(jnp.sum(offset**2, axis=-1)))


def nearest(
    position: Float[Array, "entities 2"], observers: range, others: range, count: int
) -> Int[Array, "observers count"]:
    """The indices of the `count` entities of `others` that are nearest to each observer, nearest first."""
    _, index = jax.lax.top_k(-distances(position, observers, others), count)
    return others.start + index


def relative(
    position: Float[Array, "entities 2"], observers: range, seen: Int[Array, "observers count"]
) -> Float[Array, "observers count 2"]:
    """The positions of the seen entities, minus the observer's own position."""
    return position[seen] - span(position, observers)[:, None]


def span(values: Float[Array, "entities 2"], entities: range) -> Float[Array, "some 2"]:
    """The rows of a range of entities."""
    return values[entities.start : entities.stop]


def same(observers: range, others: range) -> np.ndarray:
    """Where observer and other are the same entity."""
    return np.asarray(observers)[:, None] == np.asarray(others)


def rows(*parts: Float[Array, "observers ..."]) -> Float[Array, "observers observation"]:
    """One row of numbers for each observer."""
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
