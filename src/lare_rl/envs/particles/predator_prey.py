"""Predator and prey: slow predators should catch fast preys between obstacles.

    predator:  r_i = -0.1 * min_j |x_i - p_j| + 10 * #{j: |x_i - p_j| < PREDATOR + PREY}
    prey:      r_j = -10 * #{i: |x_i - p_j| < PREDATOR + PREY}

after `simple_tag` of the multi-agent particle environments (Lowe et al., 2017), in the form of STAS and LaRe
(`simple_tag_n6_noshare` and so on, where the predators learn and the preys follow a script, and `hetero_tag_n6_noshare`,
where both learn).
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.particles.nearest import distances, nearest, relative, rows, span
from lare_rl.envs.particles.prey import Layers, act, shipped_prey
from lare_rl.envs.particles.task import ParticleTask, Team
from lare_rl.envs.particles.world import State, World, at_rest

PREDATOR_SENSITIVITY, PREY_SENSITIVITY = 3.0, 4.0
PREDATOR_SPEED, PREY_SPEED = 1.0, 1.3
CATCH = 10.0
"""The reward of a predator, and the loss of a prey, for each touch in a step."""
DISTANCE_WEIGHT = 0.1
MARGIN = 0.1
"""Obstacles keep this distance from the border of the square in which all other entities start."""


@dataclass(frozen=True)
class Sees:
    """The number of nearest entities of each kind that an agent sees."""

    landmarks: int
    predators: int
    preys: int

    @property
    def observation_size(self) -> int:
        return 4 + 2 * self.landmarks + 2 * self.predators + 4 * self.preys


@dataclass(frozen=True)
class Size:
    """Numbers of entities, their radii, and the numbers of entities that agents see."""

    predators: int
    preys: int
    landmarks: int
    radius: float
    predator: float
    prey: float
    landmark: float
    predator_sees: Sees
    prey_sees: Sees = Sees(3, 6, 1)

    @property
    def hunters(self) -> range:
        return range(self.predators)

    @property
    def hunted(self) -> range:
        return range(self.predators, self.predators + self.preys)

    @property
    def obstacles(self) -> range:
        return range(self.hunted.stop, self.hunted.stop + self.landmarks)


SIZES = {
    "PP-6": Size(6, 2, 3, 1.5, 0.075, 0.05, 0.2, Sees(3, 5, 2)),
    "PP-15": Size(15, 5, 5, 1.0, 0.02, 0.01, 0.1, Sees(3, 6, 3)),
    "PP-30": Size(30, 10, 10, 1.0, 0.01, 0.005, 0.05, Sees(5, 6, 5)),
}
COMPETITIVE = Size(6, 2, 3, 1.5, 0.075, 0.05, 0.2, Sees(3, 5, 1), Sees(3, 5, 1))


def predator_prey(name: str) -> ParticleTask:
    """The task in which only the predators learn."""
    size = SIZES[name]
    return ParticleTask(
        name=name,
        teams=(Team("predator", 0, size.predators),),
        observation_size=size.predator_sees.observation_size,
        radius=size.radius,
        world=world(size),
        reset=partial(reset, size),
        observe=partial(observe_predators, size),
        reward=partial(reward_predators, size),
        script=lambda state, key: flee(size, shipped_prey(), state, key),
    )


def competitive() -> ParticleTask:
    """The task in which predators and preys learn. Their observations have the same size, so that one network can serve both."""
    size = COMPETITIVE
    return ParticleTask(
        name="CompetitivePP-6",
        teams=(Team("predator", 0, size.predators), Team("prey", size.predators, size.hunted.stop)),
        observation_size=size.predator_sees.observation_size,
        radius=size.radius,
        world=world(size),
        reset=partial(reset, size),
        observe=lambda state: jnp.concatenate([observe_predators(size, state), observe_preys(size, state)]),
        reward=lambda state: jnp.concatenate([reward_predators(size, state), reward_preys(size, state)]),
    )


def world(size: Size) -> World:
    """All entities collide, and all pairs at the distance at which two predators touch: so the published tasks are defined.

    Entities can thus overlap the drawn obstacles, and a predator must push slightly into a prey to catch it.
    """
    moving, entities = size.hunted.stop, size.obstacles.stop
    kinds = [size.predators, size.preys]
    return World(
        size=np.repeat([size.predator, size.prey, size.landmark], [*kinds, size.landmarks]).astype(np.float32),
        moving=moving,
        colliding=entities,
        sensitivity=np.repeat([PREDATOR_SENSITIVITY, PREY_SENSITIVITY], kinds).astype(np.float32),
        max_speed=np.repeat([PREDATOR_SPEED, PREY_SPEED], kinds).astype(np.float32),
        contact=np.full((entities, entities), 2 * size.predator, np.float32),
    )


def reset(size: Size, key: PRNGKeyArray) -> State:
    """All entities start uniformly in their squares, and may overlap."""
    reach = jnp.array([size.radius] * size.hunted.stop + [size.radius - MARGIN] * size.landmarks)
    return at_rest(reach[:, None] * jax.random.uniform(key, (len(reach), 2), minval=-1, maxval=1))


def observe_predators(size: Size, state: State) -> Float[Array, "predators observation"]:
    return observe(size, state, size.hunters, size.predator_sees)


def observe_preys(size: Size, state: State) -> Float[Array, "preys observation"]:
    return observe(size, state, size.hunted, size.prey_sees)


def observe(size: Size, state: State, observers: range, sees: Sees) -> Float[Array, "observers observation"]:
    """Each observer's velocity and position; the nearest obstacles, other predators and other preys; these preys' velocities."""
    position = state.position
    preys = nearest(position, observers, size.hunted, sees.preys)
    return rows(
        span(state.velocity, observers),
        span(position, observers),
        relative(position, observers, nearest(position, observers, size.obstacles, sees.landmarks)),
        relative(position, observers, nearest(position, observers, size.hunters, sees.predators)),
        relative(position, observers, preys),
        state.velocity[preys],
    )


def touches(size: Size, state: State) -> Float[Array, "predators preys"]:
    """1 where a predator touches a prey."""
    return (distances(state.position, size.hunters, size.hunted) < size.predator + size.prey).astype(jnp.float32)


def reward_predators(size: Size, state: State) -> Float[Array, " predators"]:
    to_prey = jnp.min(distances(state.position, size.hunters, size.hunted), axis=1)
    return CATCH * jnp.sum(touches(size, state), axis=1) - DISTANCE_WEIGHT * to_prey


def reward_preys(size: Size, state: State) -> Float[Array, " preys"]:
    return -CATCH * jnp.sum(touches(size, state), axis=0)


def flee(size: Size, layers: Layers, state: State, key: PRNGKeyArray) -> Int[Array, " preys"]:
    """The actions of scripted preys."""
    return act(layers, observe_preys(size, state), key)


def chase(size: Size, state: State) -> Int[Array, " predators"]:
    """The actions of greedy predators, which are used to evaluate preys. They move along the axis on which the nearest prey is
    further away.
    """
    prey = nearest(state.position, size.hunters, size.hunted, 1)
    x, y = jnp.moveaxis(relative(state.position, size.hunters, prey)[:, 0], -1, 0)
    return jnp.where(jnp.abs(x) > jnp.abs(y), jnp.where(x > 0, 2, 1), jnp.where(y > 0, 4, 3))
