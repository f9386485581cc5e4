"""Precision and threads within `float64`."""

import jax.numpy as jnp
from threadpoolctl import threadpool_info, threadpool_limits

from lare_rl.util.float64 import float64


def n_threads():
    """Return the threads of the LAPACK that JAX calls, which is SciPy's. Other tests load other libraries."""
    libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
    return {library["num_threads"] for library in libraries if "scipy" in library["filepath"]}


def test_float64_with_one_thread():
    with threadpool_limits(2, user_api="blas"):
        with float64():
            assert (jnp.ones(3).dtype, n_threads()) == (jnp.float64, {1})
        assert (jnp.ones(3).dtype, n_threads()) == (jnp.float32, {2})
