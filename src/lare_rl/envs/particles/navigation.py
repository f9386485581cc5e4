"""Cooperative navigation: n agents should reach n landmarks without colliding.

    r_i = -min_l |x_i - x_l| - #{j != i: |x_i - x_j| < 2 * AGENT_RADIUS}

after `simple_spread` of the multi-agent particle environments (Lowe et al., 2017), in the form of STAS and LaRe
(`simple_spread_n6_noshare` and so on). Landmarks keep a minimum distance, by Poisson disc sampling (Bridson, SIGGRAPH 2007).
"""

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.envs.interface import Team
from lare_rl.envs.particles import views
from lare_rl.envs.particles.task import ParticleTask
from lare_rl.envs.particles.world import State, World, at_rest

__all__ = ["SIZES", "Size", "navigation"]

AGENT_RADIUS, LANDMARK_RADIUS = 0.15, 0.05
SENSITIVITY = 5.0
"""The force of an action."""
SEPARATION = 4.5 * AGENT_RADIUS
"""Landmarks are further apart than this."""
N_VISIBLE_LANDMARKS, N_VISIBLE_AGENTS = 6, 5
"""The numbers of nearest landmarks and nearest agents that an agent sees."""
N_CANDIDATES = 5
"""The number of points that are tried around each point."""
N_LAYOUTS = 2048
"""The number of precomputed layouts. Each episode draws one of them."""


@dataclass(frozen=True)
class Size:
    """The number of agents, and the square in which they start."""

    n_agents: int
    """Also the number of landmarks."""
    half_side: float

    @property
    def agents(self) -> range:
        return range(self.n_agents)

    @property
    def landmarks(self) -> range:
        return range(self.n_agents, 2 * self.n_agents)


SIZES = {"CN-6": Size(6, 1.5), "CN-15": Size(15, 2.2), "CN-30": Size(30, 3.0)}


def navigation(name: str) -> ParticleTask:
    """Make a task of `SIZES`."""
    size = SIZES[name]
    return ParticleTask(
        name=name,
        teams=(Team("agent", 0, size.n_agents),),
        observation_size=4 + 2 * N_VISIBLE_LANDMARKS + 2 * N_VISIBLE_AGENTS,
        half_side=size.half_side,
        world=_world(size),
        reset=partial(_reset, size),
        observe=partial(_observe, size),
        reward=partial(_reward, size),
    )


def _world(size: Size) -> World:
    """Make the world. Agents push each other, landmarks do not."""
    n = size.n_agents
    return World(
        radius=np.array([AGENT_RADIUS] * n + [LANDMARK_RADIUS] * n, np.float32),
        n_moving=n,
        n_colliding=n,
        sensitivity=np.full(n, SENSITIVITY, np.float32),
        max_speed=np.full(n, np.inf, np.float32),
        contact=np.full((n, n), 2 * AGENT_RADIUS, np.float32),
    )


def _reset(size: Size, key: PRNGKeyArray) -> State:
    """Place agents uniformly in the square, and landmarks at the points of a random layout."""
    agents_key, landmarks_key = jax.random.split(key)
    agents = jax.random.uniform(agents_key, (size.n_agents, 2), minval=-size.half_side, maxval=size.half_side)
    layouts = jnp.asarray(_make_layouts(size))
    landmarks = layouts[jax.random.randint(landmarks_key, (), 0, len(layouts))]
    return at_rest(jnp.concatenate([agents, landmarks]))


def _observe(size: Size, state: State) -> Float[Array, "agents observation"]:
    """Return each agent's velocity and position, the nearest landmarks, and the nearest other agents."""
    return views.concatenate_rows(
        views.slice_rows(state.velocity, size.agents),
        views.slice_rows(state.position, size.agents),
        views.nearest_positions(state.position, size.agents, size.landmarks, N_VISIBLE_LANDMARKS),
        views.nearest_positions(state.position, size.agents, size.agents, N_VISIBLE_AGENTS),
    )


def _reward(size: Size, state: State) -> Float[Array, " agents"]:
    to_landmarks = views.distances(state.position, size.agents, size.landmarks)
    to_agents = views.distances(state.position, size.agents, size.agents)
    return -jnp.min(to_landmarks, axis=1) - jnp.sum(to_agents < 2 * AGENT_RADIUS, axis=1)


@cache
def _make_layouts(size: Size) -> Float[np.ndarray, "layouts landmarks 2"]:
    """Return N_LAYOUTS layouts of landmarks in the square, which are further apart than SEPARATION.

    A layout is a uniform choice among the points of a Poisson disc sample that has enough of them. The result is always the same.
    """
    rng = np.random.default_rng(0)
    layouts: list[np.ndarray] = []
    while sum(map(len, layouts)) < N_LAYOUTS:
        samples = _sample_poisson_discs(rng, N_LAYOUTS // 2, 2 * size.half_side)
        # A random order of the points, with the missing points last.
        rank = np.where(np.isinf(samples[..., 0]), np.inf, rng.random(samples.shape[:2]))
        order = np.argsort(rank, axis=1)[:, : size.n_agents]
        candidates = np.take_along_axis(samples, order[..., None], axis=1)
        layouts.append(candidates[np.isfinite(candidates).all(axis=(1, 2))])
    return (np.concatenate(layouts)[:N_LAYOUTS] - size.half_side).astype(np.float32)


def _sample_poisson_discs(
    rng: np.random.Generator, n_samples: int, side: float
) -> Float[np.ndarray, "n_samples max_points 2"]:
    """Return Poisson disc samples of a square (0, side)^2, computed in lockstep. Missing points of smaller samples are `inf`.

    Bridson's algorithm starts with one active point, uniform in the square. It then chooses an active point at random and tries
    N_CANDIDATES points, uniform in the ring of SEPARATION to 2 * SEPARATION around it. Candidates that are further than SEPARATION
    from all existing points are added and become active; the selected point becomes inactive. It ends if no point is active.
    """
    # Discs with a radius of half of SEPARATION do not overlap, and lie within a square of side + SEPARATION.
    max_points = int((side + SEPARATION) ** 2 / (np.pi * SEPARATION**2 / 4))
    points = np.full((n_samples, max_points, 2), np.inf)
    points[:, 0] = side * rng.random((n_samples, 2))
    active = np.zeros((n_samples, max_points), bool)
    active[:, 0] = True
    n_points = np.ones(n_samples, int)
    running = np.arange(n_samples)
    while len(running):
        used = n_points.max() + N_CANDIDATES
        centre = np.argmax(rng.random((len(running), min(used, max_points))) * active[running, :used], axis=1)
        active[running, centre] = False
        for _ in range(N_CANDIDATES):
            angle, u = 2 * np.pi * rng.random(len(running)), rng.random(len(running))
            # The root of 1 + 3 u makes the candidates uniform by area between 1 and 2 separations.
            distance = SEPARATION * np.sqrt(1 + 3 * u)
            point = points[running, centre] + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            offset = points[running, :used] - point[:, None]
            is_far = (offset[..., 0] ** 2 + offset[..., 1] ** 2 > SEPARATION**2).all(axis=1)
            is_new = is_far & ((point >= 0) & (point < side)).all(axis=1)
            sample = running[is_new]
            points[sample, n_points[sample]] = point[is_new]
            active[sample, n_points[sample]] = True
            n_points[sample] += 1
        running = running[active[running].any(axis=1)]
    return points[:, : n_points.max()]
