"""Precision and threads within `float64`."""

import jax
import jax.numpy as jnp
import pytest
import scipy.linalg  # noqa: F401 - loads the library that `float64` limits
from threadpoolctl import threadpool_info, threadpool_limits

from lare_rl.errors import LareError
from lare_rl.util.float64 import float64, require_float32


def n_threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_require_float32():
    require_float32()
    with jax.enable_x64(True), pytest.raises(LareError, match="JAX_ENABLE_X64"):
        require_float32()


def test_float64_with_one_thread():
    with threadpool_limits(2, "blas"):
        with float64():
            assert (jnp.ones(3).dtype, n_threads()) == (jnp.float64, {1})
        assert (jnp.ones(3).dtype, n_threads()) == (jnp.float32, {2})
