"""Positions of landmarks with a minimum distance, by Poisson disc sampling (Bridson, SIGGRAPH 2007)."""

from functools import cache

import numpy as np
from jaxtyping import Float

__all__ = ["N_LAYOUTS", "make_layouts"]

N_CANDIDATES = 5
"""The number of points that are tried around each point."""
N_LAYOUTS = 2048
"""The number of precomputed layouts. Each episode draws one of them."""


@cache
def make_layouts(points: int, radius: float, separation: float) -> Float[np.ndarray, "layouts points 2"]:
    """Return N_LAYOUTS layouts of `points` points within ±radius, which are further apart than `separation`.

    The result is always the same. A layout is a uniform choice among the points of a sample that has enough points.
    """
    rng = np.random.default_rng(0)
    layouts: list[np.ndarray] = []
    while sum(map(len, layouts)) < N_LAYOUTS:
        samples = _sample_poisson_discs(rng, N_LAYOUTS // 2, 2 * radius, separation)
        # A random order of the points, with the missing points last.
        rank = np.where(np.isinf(samples[..., 0]), np.inf, rng.random(samples.shape[:2]))
        selected = np.argsort(rank, axis=1)[:, :points]
        selected = np.take_along_axis(samples, selected[..., None], axis=1)
        layouts.append(selected[np.isfinite(selected).all(axis=(1, 2))])
    return (np.concatenate(layouts)[:N_LAYOUTS] - radius).astype(np.float32)


def _sample_poisson_discs(
    rng: np.random.Generator, samples: int, side: float, separation: float
) -> Float[np.ndarray, "samples max_points 2"]:
    """Return Poisson disc samples of a square (0, side)^2, computed in lockstep. Missing points of smaller samples are `inf`.

    Bridson's algorithm starts with one active point, uniform in the square. It then chooses an active point at random and tries
    N_CANDIDATES points, uniform in the ring of separation to 2 * separation around it. Candidates that are further than `separation`
    from all existing points are added and become active; the selected point becomes inactive. It ends if no point is active.
    """
    # Discs with a radius of half the separation do not overlap, and lie within a square of side + separation.
    max_points = int((side + separation) ** 2 / (np.pi * separation**2 / 4))
    points = np.full((samples, max_points, 2), np.inf)
    points[:, 0] = side * rng.random((samples, 2))
    active = np.zeros((samples, max_points), bool)
    active[:, 0] = True
    n_points = np.ones(samples, int)
    running = np.arange(samples)
    while len(running):
        used = n_points.max() + N_CANDIDATES
        centre = np.argmax(rng.random((len(running), min(used, max_points))) * active[running, :used], axis=1)
        active[running, centre] = False
        for _ in range(N_CANDIDATES):
            angle, u = 2 * np.pi * rng.random(len(running)), rng.random(len(running))
            # 1 + 3 u: uniform by area between 1 and 2 separations.
            reach = separation * np.sqrt(1 + 3 * u)
            point = points[running, centre] + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            offset = points[running, :used] - point[:, None]
            is_far = (offset[..., 0] ** 2 + offset[..., 1] ** 2 > separation**2).all(axis=1)
            is_new = is_far & ((point >= 0) & (point < side)).all(axis=1)
            sample = running[is_new]
            points[sample, n_points[sample]] = point[is_new]
            active[sample, n_points[sample]] = True
            n_points[sample] += 1
        running = running[active[running].any(axis=1)]
    return points[:, : n_points.max()]
