"""Calculations in float64, for fits in closed form."""

import contextlib
from collections.abc import Iterator
from functools import cache

import jax
from threadpoolctl import ThreadpoolController


@contextlib.contextmanager
def float64() -> Iterator[None]:
    """Within it, JAX calculates in float64, and libraries of linear algebra use one thread. Results must be waited for within it.

    The matrices of a fit are small. With several threads, the libraries wait actively until each of them has run. On a machine
    whose cores have other work, a fit then takes a hundred times as long.
    """
    with jax.enable_x64(True), libraries().limit(limits=1, user_api="blas"):
        yield


@cache
def libraries() -> ThreadpoolController:
    """The libraries that this process has loaded."""
    import scipy.linalg  # noqa: F401 - JAX calls the LAPACK that SciPy loads

    return ThreadpoolController()
