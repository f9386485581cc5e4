"""The particle tasks once more, slowly: float64, one entity at a time, written from their description alone."""

import math
from typing import NamedTuple

import numpy as np

MOVES = {0: (0, 0), 1: (-1, 0), 2: (1, 0), 3: (0, -1), 4: (0, 1)}


class Body(NamedTuple):
    kind: str
    size: float
    force: float = 0.0
    limit: float = math.inf


class Twin(NamedTuple):
    bodies: list[Body]
    d_min: float | None
    """For every pair that collides; the sum of the radii where None."""
    visible: dict[str, list[tuple[str, int]]]
    """What each kind of agent sees: kinds and how many of the nearest; `velocity` of those named before it."""


def cn(n: int) -> Twin:
    bodies = [Body("agent", 0.15, 5.0)] * n + [Body("goal", 0.05)] * n
    return Twin(bodies, 0.3, {"agent": [("goal", 6), ("agent", 5)]})


def pp(n, p, obstacles, sizes, d_min, observation, prey_visible=None) -> Twin:
    predator, prey, obstacle = sizes
    bodies = [Body("predator", predator, 3.0, 1.0)] * n + [Body("prey", prey, 4.0, 1.3)] * p
    bodies += [Body("obstacle", obstacle)] * obstacles
    kinds = ("obstacle", "predator", "prey")
    views = {"predator": list(zip(kinds, observation, strict=True))}
    if prey_visible:
        views["prey"] = list(zip(kinds, prey_visible, strict=True))
    return Twin(bodies, d_min, views)


TWINS = {
    "CN-6": cn(6),
    "CN-15": cn(15),
    "CN-30": cn(30),
    "PP-6": pp(6, 2, 3, (0.075, 0.05, 0.2), 0.15, (3, 5, 2)),
    "PP-15": pp(15, 5, 5, (0.02, 0.01, 0.1), 0.04, (3, 6, 3)),
    "PP-30": pp(30, 10, 10, (0.01, 0.005, 0.05), 0.02, (5, 6, 5)),
    "CompetitivePP-6": pp(6, 2, 3, (0.075, 0.05, 0.2), 0.15, (3, 5, 1), (3, 5, 1)),
    "TriangleArea": Twin([Body("corner", 0.15, 5.0)] * 3 + [Body("obstacle", 0.4)] * 3, None, {"corner": []}),
}


def learners(twin: Twin) -> list[int]:
    return [i for i, body in enumerate(twin.bodies) if body.kind in twin.visible]


def step(twin: Twin, position: np.ndarray, velocity: np.ndarray, actions: list[int]) -> tuple[np.ndarray, np.ndarray]:
    new_position, new_velocity = position.copy(), velocity.copy()
    for i, action in enumerate(actions):
        body = twin.bodies[i]
        force = body.force * np.array(MOVES[action], np.float64)
        for j, other in enumerate(twin.bodies):
            if i == j or "goal" in (body.kind, other.kind):
                continue
            way = position[i] - position[j]
            distance = math.hypot(*way)
            depth = ((body.size + other.size if twin.d_min is None else twin.d_min) - distance) / 1e-3
            # log(1 + e^x) is x to all digits long before e^x overflows.
            softly = depth if depth > 50 else math.log1p(math.exp(max(depth, -700)))
            force += 100 * 1e-3 * softly * way / distance
        new_velocity[i] = 0.75 * velocity[i] + 0.1 * force
        speed = math.hypot(*new_velocity[i])
        if speed > body.limit:
            new_velocity[i] *= body.limit / speed
        new_position[i] = position[i] + 0.1 * new_velocity[i]
    return new_position, new_velocity


def by_distance(twin: Twin, position: np.ndarray, i: int, kind: str) -> list[int]:
    neighbours = [j for j, body in enumerate(twin.bodies) if body.kind == kind and j != i]
    return sorted(neighbours, key=lambda j: math.dist(position[i], position[j]))


def observe(twin: Twin, position: np.ndarray, velocity: np.ndarray, i: int) -> list[float]:
    kind = twin.bodies[i].kind
    observation = [*velocity[i], *position[i]]
    if kind == "corner":
        for j in (3, 4, 5):
            observation += [*(position[j] - position[i])]
        for way in sorted(tuple(position[j] - position[i]) for j in range(3) if j != i):
            observation += [*way]
    for other, count in twin.visible[kind]:
        chosen = by_distance(twin, position, i, other)[:count]
        for j in chosen:
            observation += [*(position[j] - position[i])]
        if other == "prey":
            for j in chosen:
                observation += [*velocity[j]]
    return observation


def touching(twin: Twin, position: np.ndarray, i: int, kind: str) -> int:
    return sum(
        math.dist(position[i], position[j]) < twin.bodies[i].size + twin.bodies[j].size
        for j in by_distance(twin, position, i, kind)
    )


def area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return abs(a[0] * (b[1] - c[1]) + b[0] * (c[1] - a[1]) + c[0] * (a[1] - b[1])) / 2


def reward(twin: Twin, position: np.ndarray, i: int) -> float:
    match twin.bodies[i].kind:
        case "agent":
            goal = by_distance(twin, position, i, "goal")[0]
            return -math.dist(position[i], position[goal]) - touching(twin, position, i, "agent")
        case "predator":
            prey = by_distance(twin, position, i, "prey")[0]
            return 10 * touching(twin, position, i, "prey") - 0.1 * math.dist(position[i], position[prey])
        case "prey":
            return -10 * touching(twin, position, i, "predator")
        case _:
            return 0.3 * area(*position[:3]) - sum(touching(twin, position, j, "obstacle") for j in range(3))
