"""Whether the fits of several decoders are faster at once or one after the other, which depends on the device."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.credit.score_type import ScoreType
from lare_rl.nn.leading_axis import map_leading_axis
from lare_rl.training.static_config import TrainConfig
from lare_rl.util.float64 import float64

__all__ = ["is_batching_faster"]

MIN_SPEED_UP = 2.0
"""Less may be noise, and then a run would not always choose the same."""
N_REPETITIONS, N_STARTS = 5, 3
MIN_FEATURES = 32
"""The size of the matrix if no fit is in closed form."""


def is_batching_faster(config: TrainConfig, n_seeds: int) -> bool:
    """Measure whether this device factorises the matrices of all fits faster at once than one after the other.

    On a CPU, it is never faster by much, and a choice by time would make runs differ. Besides, batched calls of LAPACK that run at
    the same time may wait for each other for ever (jaxlib 0.10, `ParallelBatchMap`).
    """
    if config.method.fit is None or jax.default_backend() == "cpu":
        return False
    n_features = max(MIN_FEATURES, *(spec.basis.n_features for spec in config.credit_specs))
    n_fits = n_seeds // config.n_devices * N_STARTS * len(ScoreType)
    with float64():
        matrices = jnp.asarray(np.eye(n_features) + np.full((n_fits, n_features, n_features), 0.5))
        one_after_the_other, at_once = (_measure_s(_factorise(batched), matrices) for batched in (False, True))
    return one_after_the_other > MIN_SPEED_UP * at_once


def _factorise(batched: bool) -> Callable[..., Array]:
    return jax.jit(lambda matrices: map_leading_axis(jnp.linalg.cholesky, matrices, batched=batched))


def _measure_s(function: Callable[..., Array], matrices: Float[Array, "fits features features"]) -> float:
    """Return the shortest time of a call (s), after one that compiles."""
    times = []
    for _ in range(1 + N_REPETITIONS):
        start = time.perf_counter()
        jax.block_until_ready(function(matrices))
        times.append(time.perf_counter() - start)
    return min(times[1:])
