"""The physics of the particle tasks: discs of mass 1 in a plane without walls (Lowe et al., MADDPG, 2017).

    F = sensitivity * direction + sum of contact forces
    v <- (1 - DAMPING) v + TIME_STEP * F                  then scaled down to at most max_speed
    x <- x + TIME_STEP * v                                with the new velocity

and, for two discs that collide, d apart, x_a - x_b = d * n,

    contact force on a = CONTACT_FORCE * CONTACT_MARGIN * log(1 + exp((d_min - d) / CONTACT_MARGIN)) * n

which is close to CONTACT_FORCE * (d_min - d) if d < d_min, and close to 0 if they do not touch.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

__all__ = ["State", "World", "at_rest", "contact_force", "move", "place_uniformly", "push"]

TIME_STEP = 0.1
DAMPING = 0.25
"""The share of its velocity that each entity loses in a step."""
CONTACT_FORCE = 100.0
"""Force for each unit of length by which two discs overlap."""
CONTACT_MARGIN = 1e-3
"""The distance over which the contact force sets in."""

DIRECTIONS = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)], np.float32)
"""The directions of the five actions: none, left, right, down, up."""


@dataclass(frozen=True, eq=False)
class World:
    """The constants of a world. The first `n_moving` entities are agents and preys. The others are landmarks, which do not move."""

    radius: Float[np.ndarray, " entities"]
    n_moving: int
    n_colliding: int
    """The first `n_colliding` entities push each other away. These are the moving entities, or all."""
    sensitivity: Float[np.ndarray, " n_moving"]
    """The force of an action."""
    max_speed: Float[np.ndarray, " n_moving"]
    """`inf` if there is no limit."""
    contact: Float[np.ndarray, "colliding colliding"]
    """d_min: the distance between two centres below which the entities push each other."""


class State(NamedTuple):
    """The variables of a world, which a step changes."""

    position: Float[Array, "entities 2"]
    velocity: Float[Array, "entities 2"]


def at_rest(position: Float[Array, "entities 2"]) -> State:
    """Return a state without motion."""
    return State(position, jnp.zeros_like(position))


def place_uniformly(key: PRNGKeyArray, half_side: Float[Array, " entities"]) -> State:
    """Return a state without motion, with each entity uniform in its own square. Entities may overlap."""
    return at_rest(half_side[:, None] * jax.random.uniform(key, (len(half_side), 2), minval=-1, maxval=1))


def push(world: World, action: Int[Array, " moving"]) -> Float[Array, "moving 2"]:
    """Return the force by which each entity's action moves it."""
    return jnp.asarray(world.sensitivity)[:, None] * jnp.asarray(DIRECTIONS)[action]


def contact_force(world: World, position: Float[Array, "entities 2"]) -> Float[Array, "moving 2"]:
    """Return the sum of contact forces on each moving entity. Two entities with the same centre exert no force."""
    bodies = position[: world.n_colliding]
    offset = bodies[: world.n_moving, None] - bodies
    distance = jnp.sqrt(jnp.sum(offset**2, axis=-1))
    overlap = (world.contact[: world.n_moving] - distance) / CONTACT_MARGIN
    force = CONTACT_FORCE * CONTACT_MARGIN * jnp.logaddexp(overlap, 0)
    # The distance of an entity to itself is 0.
    return jnp.sum((force / jnp.where(distance > 0, distance, jnp.inf))[..., None] * offset, axis=1)


def move(world: World, state: State, force: Float[Array, "moving 2"]) -> State:
    """Make one step. Contact forces follow from the positions before it."""
    force = force + contact_force(world, state.position)
    velocity = (1 - DAMPING) * state.velocity[: world.n_moving] + TIME_STEP * force
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1))
    velocity = jnp.where(speed > world.max_speed, world.max_speed / speed, 1)[:, None] * velocity
    moved = state.position[: world.n_moving] + TIME_STEP * velocity
    return State(state.position.at[: world.n_moving].set(moved), state.velocity.at[: world.n_moving].set(velocity))
