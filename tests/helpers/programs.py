"""Programs on steps of HalfCheetah: as the graph that is read, and as Python computes them."""

import math

import numpy as np

from lare_rl.latent.factors import compute_factors
from lare_rl.phi.read import read


def batch(rows: int = 5) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    observation, action = random.standard_normal((rows, 17)), random.uniform(-1, 1, (rows, 6))
    return observation.astype(np.float32), action.astype(np.float32)


def by_graph(source: str) -> np.ndarray:
    """The factors of a program by the graph that is read."""
    return compute_factors(read(source, 17, 6), *batch())


def by_python(source: str) -> np.ndarray:
    """The factors of a program that Python executes."""
    names = {"np": np, "math": math}
    exec(compile(source, "phi", "exec"), names)
    return np.concatenate(names["evaluation_func"](*batch()), axis=1, dtype=np.float32)
