"""Predator and prey: slow predators shall catch fast preys between obstacles.

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

from lare.tasks.particles.nearest import distances, nearest, relative, rows, span
from lare.tasks.particles.prey import Layers, act, shipped_prey
from lare.tasks.particles.task import ParticleTask, Team
from lare.tasks.particles.world import State, World, at_rest

PREDATOR_SENSITIVITY, PREY_SENSITIVITY = 3.0, 4.0
PREDATOR_SPEED, PREY_SPEED = 1.0, 1.3
CATCH = 10.0
"""What a predator earns, and a prey loses, by each touch and step."""
DISTANCE_WEIGHT = 0.1
MARGIN = 0.1
"""Obstacles lie that far within the square in which all others start."""


@dataclass(frozen=True)
class Sees:
    """How many of the nearest of each kind an agent sees."""

    landmarks: int
    predators: int
    preys: int

    @property
    def observation_size(self) -> int:
        return 4 + 2 * self.landmarks + 2 * self.predators + 4 * self.preys


@dataclass(frozen=True)
class Size:
    """Numbers of entities, radii, and what is seen."""

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
    """The predators learn."""
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
    """Predators and preys learn. They see equally many numbers, so that one network can serve both."""
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
    """All collide, and all pairs from the distance on at which two predators touch: that is how these tasks are defined.

    So obstacles are passed more closely than they are drawn, and a catch means to push a little way into a prey.
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
    """Everything uniform in its square; overlaps may happen."""
    reach = jnp.array([size.radius] * size.hunted.stop + [size.radius - MARGIN] * size.landmarks)
    return at_rest(reach[:, None] * jax.random.uniform(key, (len(reach), 2), minval=-1, maxval=1))


def observe_predators(size: Size, state: State) -> Float[Array, "predators observation"]:
    return observe(size, state, size.hunters, size.predator_sees)


def observe_preys(size: Size, state: State) -> Float[Array, "preys observation"]:
    return observe(size, state, size.hunted, size.prey_sees)


def observe(size: Size, state: State, observers: range, sees: Sees) -> Float[Array, "observers observation"]:
    """Own velocity and position; the nearest obstacles, predators, preys, none of them oneself; these preys' velocities."""
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
    """The actions of greedy predators: along the axis on which the nearest prey is further away. A yardstick for preys."""
    prey = nearest(state.position, size.hunters, size.hunted, 1)
    x, y = jnp.moveaxis(relative(state.position, size.hunters, prey)[:, 0], -1, 0)
    return jnp.where(jnp.abs(x) > jnp.abs(y), jnp.where(x > 0, 2, 1), jnp.where(y > 0, 4, 3))
