"""Triangle area: three agents should form a large triangle and avoid three obstacles.

    R = sum_i (0.1 * area - #{l: |x_i - x_l| < AGENT_RADIUS + OBSTACLE_RADIUS})       the same for every agent

after `simple_area` of LaRe. The area is half the cross product of two sides. The published code uses Heron's formula, which may
take the root of a negative number because of rounding.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.interface import Team
from lare_rl.envs.particles import views
from lare_rl.envs.particles.task import ParticleTask
from lare_rl.envs.particles.world import State, World, place_uniformly

__all__ = ["triangle_area"]

AGENTS, OBSTACLES = range(3), range(3, 6)
AGENT_RADIUS, OBSTACLE_RADIUS = 0.15, 0.4
SENSITIVITY = 5.0
"""The force of an action."""
AREA_WEIGHT = 0.1
AGENT_RANGE, OBSTACLE_RANGE = 0.2, 1.5
"""Agents start within ±AGENT_RANGE, obstacles within ±OBSTACLE_RANGE."""


def triangle_area() -> ParticleTask:
    return ParticleTask(
        name="TriangleArea",
        teams=(Team("agent", 0, len(AGENTS)),),
        observation_size=4 + 2 * len(OBSTACLES) + 2 * (len(AGENTS) - 1),
        half_side=OBSTACLE_RANGE,
        world=_world(),
        reset=_reset,
        observe=_observe,
        reward=_reward,
    )


def _world() -> World:
    """Make the world. Agents and obstacles push each other when they touch."""
    radius = np.array([AGENT_RADIUS] * len(AGENTS) + [OBSTACLE_RADIUS] * len(OBSTACLES), np.float32)
    return World(
        radius=radius,
        n_moving=len(AGENTS),
        n_colliding=len(radius),
        sensitivity=np.full(len(AGENTS), SENSITIVITY, np.float32),
        max_speed=np.full(len(AGENTS), np.inf, np.float32),
        contact=radius[:, None] + radius,
    )


def _reset(key: PRNGKeyArray) -> State:
    """Place agents and obstacles. An obstacle that overlaps an agent pushes it away."""
    return place_uniformly(key, jnp.array([AGENT_RANGE] * len(AGENTS) + [OBSTACLE_RANGE] * len(OBSTACLES)))


def _observe(state: State) -> Float[Array, "agents observation"]:
    """Return each agent's velocity and position; the obstacles, in a fixed order; the other agents, sorted by x and then y."""
    obstacles = jnp.broadcast_to(jnp.array(OBSTACLES), (len(AGENTS), len(OBSTACLES)))
    other_agents = jnp.array([[j for j in AGENTS if j != i] for i in AGENTS])
    offset = views.relative_positions(state.position, AGENTS, other_agents)
    order = jax.vmap(lambda pair: jnp.lexsort((pair[:, 1], pair[:, 0])))(offset)
    return views.concatenate_rows(
        views.slice_rows(state.velocity, AGENTS),
        views.slice_rows(state.position, AGENTS),
        views.relative_positions(state.position, AGENTS, obstacles),
        jnp.take_along_axis(offset, order[..., None], axis=1),
    )


def _reward(state: State) -> Float[Array, " agents"]:
    first, second = state.position[1] - state.position[0], state.position[2] - state.position[0]
    area = jnp.abs(first[0] * second[1] - first[1] * second[0]) / 2
    overlaps = jnp.sum(views.distances(state.position, AGENTS, OBSTACLES) < AGENT_RADIUS + OBSTACLE_RADIUS)
    return jnp.full(len(AGENTS), len(AGENTS) * AREA_WEIGHT * area - overlaps)
