"""Cooperative navigation: n agents should reach n landmarks without colliding.

    r_i = -min_l |x_i - x_l| - #{j != i: |x_i - x_j| < 2 * AGENT}

after `simple_spread` of the multi-agent particle environments (Lowe et al., 2017), in the form of STAS and LaRe
(`simple_spread_n6_noshare` and so on).
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.particles.layouts import layouts
from lare_rl.envs.particles.nearest import distances, nearest, relative, rows, span
from lare_rl.envs.particles.task import ParticleTask, Team
from lare_rl.envs.particles.world import State, World, at_rest

AGENT, LANDMARK = 0.15, 0.05
"""Radii."""
SENSITIVITY = 5.0
SEPARATION = 4.5 * AGENT
"""Landmarks are further apart than this."""
SEEN_LANDMARKS, SEEN_AGENTS = 6, 5
"""The numbers of nearest landmarks and nearest agents that an agent sees."""


@dataclass(frozen=True)
class Size:
    agents: int
    """Also the number of landmarks."""
    radius: float

    @property
    def team(self) -> range:
        return range(self.agents)

    @property
    def landmarks(self) -> range:
        return range(self.agents, 2 * self.agents)


SIZES = {
    "CN-6": Size(6, 1.5),
    "CN-15": Size(15, 2.2),
    "CN-30": Size(30, 3.0),
}


def navigation(name: str) -> ParticleTask:
    size = SIZES[name]
    return ParticleTask(
        name=name,
        teams=(Team("agent", 0, size.agents),),
        observation_size=4 + 2 * SEEN_LANDMARKS + 2 * SEEN_AGENTS,
        radius=size.radius,
        world=world(size),
        reset=partial(reset, size),
        observe=partial(observe, size),
        reward=partial(reward, size),
    )


def world(size: Size) -> World:
    """Agents push each other. Landmarks do not collide with anything."""
    n = size.agents
    return World(
        size=np.array([AGENT] * n + [LANDMARK] * n, np.float32),
        moving=n,
        colliding=n,
        sensitivity=np.full(n, SENSITIVITY, np.float32),
        max_speed=np.full(n, np.inf, np.float32),
        contact=np.full((n, n), 2 * AGENT, np.float32),
    )


def reset(size: Size, key: PRNGKeyArray) -> State:
    """Agents start uniformly in the square, landmarks are at the points of a random layout."""
    agents_key, landmarks_key = jax.random.split(key)
    agents = jax.random.uniform(agents_key, (size.agents, 2), minval=-size.radius, maxval=size.radius)
    places = jnp.asarray(layouts(size.agents, size.radius, SEPARATION))
    landmarks = places[jax.random.randint(landmarks_key, (), 0, len(places))]
    return at_rest(jnp.concatenate([agents, landmarks]))


def observe(size: Size, state: State) -> Float[Array, "agents observation"]:
    """Each agent's own velocity and position, the nearest landmarks, and the nearest other agents."""
    landmarks = nearest(state.position, size.team, size.landmarks, SEEN_LANDMARKS)
    others = nearest(state.position, size.team, size.team, SEEN_AGENTS)
    return rows(
        span(state.velocity, size.team),
        span(state.position, size.team),
        relative(state.position, size.team, landmarks),
        relative(state.position, size.team, others),
    )


def reward(size: Size, state: State) -> Float[Array, " agents"]:
    to_landmarks = distances(state.position, size.team, size.landmarks)
    to_others = distances(state.position, size.team, size.team)
    return -jnp.min(to_landmarks, axis=1) - jnp.sum(to_others < 2 * AGENT, axis=1)
