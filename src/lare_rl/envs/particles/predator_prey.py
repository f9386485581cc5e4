"""Predator and prey: slow predators should catch fast preys between obstacles.

    predator:  r_i = -0.1 * min_j |x_i - p_j| + 10 * #{j: |x_i - p_j| < PREDATOR + PREY}
    prey:      r_j = -10 * #{i: |x_i - p_j| < PREDATOR + PREY}

after `simple_tag` of the multi-agent particle environments (Lowe et al., 2017), in the form of STAS and LaRe
(`simple_tag_n6_noshare` and so on, where the predators learn and the preys follow a script, and `hetero_tag_n6_noshare`,
where both learn). The script of preys is a small policy network that ships with the package, trained by `benchmarks/train_prey.py`:

    logits = W_3 relu(W_2 relu(W_1 observation)), and an action is drawn from their softmax
"""

from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lare_rl.envs.interface import Team
from lare_rl.envs.particles import views
from lare_rl.envs.particles.task import ParticleTask
from lare_rl.envs.particles.world import State, World, place_uniformly

__all__ = [
    "SIZES",
    "Layers",
    "Size",
    "View",
    "competitive",
    "logits",
    "make_world",
    "observe_preys",
    "predator_prey",
    "reset",
    "reward_predators",
    "reward_preys",
    "sample_actions",
    "shipped_prey",
]

PREDATOR_SENSITIVITY, PREY_SENSITIVITY = 3.0, 4.0
PREDATOR_SPEED, PREY_SPEED = 1.0, 1.3
CATCH = 10.0
"""The reward of a predator, and the penalty of a prey, for each touch in a step."""
DISTANCE_WEIGHT = 0.1
MARGIN = 0.1
"""Obstacles keep this distance from the border of the square in which all other entities start."""

Layers = tuple[tuple[Float[np.ndarray | Array, "_in _out"], Float[np.ndarray | Array, " _out"]], ...]
"""Weight and bias of each layer of the scripted preys' network."""


@dataclass(frozen=True)
class View:
    """The numbers of nearest entities of each kind that an agent sees."""

    landmarks: int
    predators: int
    preys: int

    @property
    def observation_size(self) -> int:
        return 4 + 2 * self.landmarks + 2 * self.predators + 4 * self.preys


@dataclass(frozen=True)
class Size:
    """The numbers of entities, their radii, the square in which they start (± half_side), and what agents see."""

    n_predators: int
    n_preys: int
    n_landmarks: int
    half_side: float
    predator_radius: float
    prey_radius: float
    landmark_radius: float
    predator_view: View
    prey_view: View = View(3, 6, 1)

    @property
    def predators(self) -> range:
        return range(self.n_predators)

    @property
    def preys(self) -> range:
        return range(self.n_predators, self.n_predators + self.n_preys)

    @property
    def obstacles(self) -> range:
        return range(self.preys.stop, self.preys.stop + self.n_landmarks)


SIZES = {
    "PP-6": Size(6, 2, 3, 1.5, 0.075, 0.05, 0.2, View(3, 5, 2)),
    "PP-15": Size(15, 5, 5, 1.0, 0.02, 0.01, 0.1, View(3, 6, 3)),
    "PP-30": Size(30, 10, 10, 1.0, 0.01, 0.005, 0.05, View(5, 6, 5)),
}
COMPETITIVE = Size(6, 2, 3, 1.5, 0.075, 0.05, 0.2, View(3, 5, 1), View(3, 5, 1))


def predator_prey(name: str) -> ParticleTask:
    """Make a task of `SIZES`, in which only the predators learn."""
    size = SIZES[name]
    return ParticleTask(
        name=name,
        teams=(Team("predator", 0, size.n_predators),),
        observation_size=size.predator_view.observation_size,
        half_side=size.half_side,
        world=make_world(size),
        reset=partial(reset, size),
        observe=partial(_observe_predators, size),
        reward=partial(reward_predators, size),
        script=lambda state, key: sample_actions(shipped_prey(), observe_preys(size, state), key),
    )


def competitive() -> ParticleTask:
    """Make the task in which predators and preys learn. Their observations have the same size, so they can share a network."""
    size = COMPETITIVE
    return ParticleTask(
        name="CompetitivePP-6",
        teams=(Team("predator", 0, size.n_predators), Team("prey", size.n_predators, size.preys.stop)),
        observation_size=size.predator_view.observation_size,
        half_side=size.half_side,
        world=make_world(size),
        reset=partial(reset, size),
        observe=lambda state: jnp.concatenate([_observe_predators(size, state), observe_preys(size, state)]),
        reward=lambda state: jnp.concatenate([reward_predators(size, state), reward_preys(size, state)]),
    )


def make_world(size: Size) -> World:
    """Make the world. All pairs of entities collide at the distance at which two predators touch, as in the published tasks.

    Entities can thus overlap the drawn obstacles, and a predator must push slightly into a prey to catch it.
    """
    n_entities, counts = size.obstacles.stop, [size.n_predators, size.n_preys, size.n_landmarks]

    def by_entity(*values: float) -> Float[np.ndarray, " _"]:
        return np.repeat(values, counts[: len(values)]).astype(np.float32)

    return World(
        radius=by_entity(size.predator_radius, size.prey_radius, size.landmark_radius),
        n_moving=size.preys.stop,
        n_colliding=n_entities,
        sensitivity=by_entity(PREDATOR_SENSITIVITY, PREY_SENSITIVITY),
        max_speed=by_entity(PREDATOR_SPEED, PREY_SPEED),
        contact=np.full((n_entities, n_entities), 2 * size.predator_radius, np.float32),
    )


def reset(size: Size, key: PRNGKeyArray) -> State:
    return place_uniformly(
        key, jnp.array([size.half_side] * size.preys.stop + [size.half_side - MARGIN] * size.n_landmarks)
    )


def _observe_predators(size: Size, state: State) -> Float[Array, "predators observation"]:
    return _observe(size, state, size.predators, size.predator_view)


def observe_preys(size: Size, state: State) -> Float[Array, "preys observation"]:
    return _observe(size, state, size.preys, size.prey_view)


def _observe(size: Size, state: State, observers: range, view: View) -> Float[Array, "observers observation"]:
    """Return each observer's velocity and position; the nearest obstacles, predators and preys; these preys' velocities."""
    position = state.position
    preys = views.nearest_entities(position, observers, size.preys, view.preys)
    return views.concatenate_rows(
        views.slice_rows(state.velocity, observers),
        views.slice_rows(position, observers),
        views.nearest_positions(position, observers, size.obstacles, view.landmarks),
        views.nearest_positions(position, observers, size.predators, view.predators),
        views.relative_positions(position, observers, preys),
        state.velocity[preys],
    )


def _touches(size: Size, state: State) -> Float[Array, "predators preys"]:
    """Return 1 where a predator touches a prey."""
    distance = views.distances(state.position, size.predators, size.preys)
    return (distance < size.predator_radius + size.prey_radius).astype(jnp.float32)


def reward_predators(size: Size, state: State) -> Float[Array, " predators"]:
    to_prey = jnp.min(views.distances(state.position, size.predators, size.preys), axis=1)
    return CATCH * jnp.sum(_touches(size, state), axis=1) - DISTANCE_WEIGHT * to_prey


def reward_preys(size: Size, state: State) -> Float[Array, " preys"]:
    return -CATCH * jnp.sum(_touches(size, state), axis=0)


# Scripted preys


@cache
def shipped_prey() -> Layers:
    """Load the prey's network, which is the same for PP-6, PP-15 and PP-30."""
    with files("lare_rl.envs.particles").joinpath("prey.npz").open("rb") as file, np.load(file) as arrays:
        return tuple((arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))


def logits(layers: Layers, observation: Float[Array, "preys observation"]) -> Float[Array, "preys actions"]:
    """Return the logits of each prey's actions."""
    *hidden, (weight, bias) = layers
    for hidden_weight, hidden_bias in hidden:
        observation = jax.nn.relu(observation @ hidden_weight + hidden_bias)
    return observation @ weight + bias


def sample_actions(
    layers: Layers, observation: Float[Array, "preys observation"], key: PRNGKeyArray
) -> Int[Array, " preys"]:
    """Sample an action of each prey from the softmax of its logits."""
    return jax.random.categorical(key, logits(layers, observation))
