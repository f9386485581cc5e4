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

from lare_rl.envs.particles.layouts import make_layouts
from lare_rl.envs.particles.nearest import concatenate_rows, distances, nearest_entities, relative_positions, slice_rows
from lare_rl.envs.particles.task import ParticleTask, Team
from lare_rl.envs.particles.world import State, World, at_rest

__all__ = ["SIZES", "navigation"]

AGENT, LANDMARK = 0.15, 0.05
"""The radii of both."""
SENSITIVITY = 5.0
"""The force of an action."""
SEPARATION = 4.5 * AGENT
"""Landmarks are further apart than this."""
N_VISIBLE_LANDMARKS, N_VISIBLE_AGENTS = 6, 5
"""The numbers of nearest landmarks and nearest agents that an agent sees."""


@dataclass(frozen=True)
class Size:
    """The number of agents, and the square in which they start."""

    n_agents: int
    """Also the number of landmarks."""
    radius: float
    """Half the side of the square."""

    @property
    def agents(self) -> range:
        return range(self.n_agents)

    @property
    def landmarks(self) -> range:
        return range(self.n_agents, 2 * self.n_agents)


SIZES = {
    "CN-6": Size(6, 1.5),
    "CN-15": Size(15, 2.2),
    "CN-30": Size(30, 3.0),
}


def navigation(name: str) -> ParticleTask:
    """Make a task of `SIZES`."""
    size = SIZES[name]
    return ParticleTask(
        name=name,
        teams=(Team("agent", 0, size.n_agents),),
        observation_size=4 + 2 * N_VISIBLE_LANDMARKS + 2 * N_VISIBLE_AGENTS,
        radius=size.radius,
        world=_world(size),
        reset=partial(_reset, size),
        observe=partial(_observe, size),
        reward=partial(_reward, size),
    )


def _world(size: Size) -> World:
    """Make the world. Agents push each other. Landmarks do not collide with anything."""
    n = size.n_agents
    return World(
        size=np.array([AGENT] * n + [LANDMARK] * n, np.float32),
        n_moving=n,
        n_colliding=n,
        sensitivity=np.full(n, SENSITIVITY, np.float32),
        max_speed=np.full(n, np.inf, np.float32),
        contact=np.full((n, n), 2 * AGENT, np.float32),
    )


def _reset(size: Size, key: PRNGKeyArray) -> State:
    """Place agents uniformly in the square, and landmarks at the points of a random layout."""
    agents_key, landmarks_key = jax.random.split(key)
    agents = jax.random.uniform(agents_key, (size.n_agents, 2), minval=-size.radius, maxval=size.radius)
    layouts = jnp.asarray(make_layouts(size.n_agents, size.radius, SEPARATION))
    landmarks = layouts[jax.random.randint(landmarks_key, (), 0, len(layouts))]
    return at_rest(jnp.concatenate([agents, landmarks]))


def _observe(size: Size, state: State) -> Float[Array, "agents observation"]:
    """Return each agent's velocity and position, the nearest landmarks, and the nearest other agents."""
    landmarks = nearest_entities(state.position, size.agents, size.landmarks, N_VISIBLE_LANDMARKS)
    other_agents = nearest_entities(state.position, size.agents, size.agents, N_VISIBLE_AGENTS)
    return concatenate_rows(
        slice_rows(state.velocity, size.agents),
        slice_rows(state.position, size.agents),
        relative_positions(state.position, size.agents, landmarks),
        relative_positions(state.position, size.agents, other_agents),
    )


def _reward(size: Size, state: State) -> Float[Array, " agents"]:
    to_landmarks = distances(state.position, size.agents, size.landmarks)
    to_agents = distances(state.position, size.agents, size.agents)
    return -jnp.min(to_landmarks, axis=1) - jnp.sum(to_agents < 2 * AGENT, axis=1)
