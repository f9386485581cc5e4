"""Positions of landmarks with a minimum distance, by Poisson disc sampling (Bridson, SIGGRAPH 2007)."""

from functools import cache

import numpy as np
from jaxtyping import Float

CANDIDATES = 5
"""The number of points that are tried around each point."""
LAYOUTS = 2048
"""The number of precomputed layouts. Each episode draws one of them."""


@cache
def layouts(points: int, radius: float, separation: float) -> Float[np.ndarray, "layouts points 2"]:
    """LAYOUTS layouts of `points` points within ±radius. The points of a layout are further apart than `separation`.

    The result is always the same. A layout is a uniform choice among the points of a sample that has enough points.
    """
    random = np.random.default_rng(0)
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < LAYOUTS:
        samples = poisson_discs(random, LAYOUTS // 2, 2 * radius, separation)
        # A random order of the points, with the missing points last.
        rank = np.where(np.isinf(samples[..., 0]), np.inf, random.random(samples.shape[:2]))
        chosen = np.argsort(rank, axis=1)[:, :points]
        chosen = np.take_along_axis(samples, chosen[..., None], axis=1)
        kept.append(chosen[np.isfinite(chosen).all(axis=(1, 2))])
    return (np.concatenate(kept)[:LAYOUTS] - radius).astype(np.float32)


def poisson_discs(
    random: np.random.Generator, samples: int, side: float, separation: float
) -> Float[np.ndarray, "samples most 2"]:
    """Poisson disc samples of a square (0, side)^2, computed in lockstep. Missing points of smaller samples are `inf`.

    Bridson's algorithm starts with one active point, uniform in the square. It then chooses an active point at random and tries
    CANDIDATES points, uniform in the ring of separation to 2 * separation around it. Those that are further than `separation`
    from all existing points are added and become active; the chosen point becomes inactive. It ends if no point is active.
    """
    # Discs with a radius of half the separation do not overlap, and lie within a square of side + separation.
    most = int((side + separation) ** 2 / (np.pi * separation**2 / 4))
    points = np.full((samples, most, 2), np.inf)
    points[:, 0] = side * random.random((samples, 2))
    active = np.zeros((samples, most), bool)
    active[:, 0] = True
    count = np.ones(samples, int)
    open_ = np.arange(samples)
    while len(open_):
        used = count.max() + CANDIDATES
        centre = np.argmax(random.random((len(open_), min(used, most))) * active[open_, :used], axis=1)
        active[open_, centre] = False
        for _ in range(CANDIDATES):
            angle, share = 2 * np.pi * random.random(len(open_)), random.random(len(open_))
            # 1 + 3 u: uniform by area between 1 and 2 separations.
            reach = separation * np.sqrt(1 + 3 * share)
            point = points[open_, centre] + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            offset = points[open_, :used] - point[:, None]
            far = (offset[..., 0] ** 2 + offset[..., 1] ** 2 > separation**2).all(axis=1)
            new = far & ((point >= 0) & (point < side)).all(axis=1)
            grown = open_[new]
            points[grown, count[grown]] = point[new]
            active[grown, count[grown]] = True
            count[grown] += 1
        open_ = open_[active[open_].any(axis=1)]
    return points[:, : count.max()]
