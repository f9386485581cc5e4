"""Calculations in float64, for fits in closed form."""

import contextlib
from collections.abc import Iterator
from functools import cache
from typing import Any

import jax
from threadpoolctl import ThreadpoolController

from lare_rl.errors import LareError

__all__ = ["float64", "load_linear_algebra", "one_blas_thread", "require_float32"]


@contextlib.contextmanager
def float64() -> Iterator[None]:
    """Let JAX calculate and trace in float64, and linear algebra use one thread. Wait for results before the block ends."""
    with jax.enable_x64(True), one_blas_thread():
        yield


def require_float32() -> None:
    """Raise `LareError` if JAX calculates in float64 everywhere."""
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue] - JAX makes it at run time
        raise LareError(
            "JAX calculates in float64 here (jax_enable_x64, or JAX_ENABLE_X64), and LaRe trains in float32: switch it off"
        )


def one_blas_thread() -> contextlib.AbstractContextManager[Any]:
    """Let linear algebra use one thread. Wait for results before the block ends.

    The matrices of a fit are small. Several threads would wait for each other in busy loops: on cores that have other work, a fit
    then takes a hundred times as long.
    """
    return _linear_algebra_libraries().limit(limits=1, user_api="blas")


def load_linear_algebra() -> None:
    """Import SciPy's linear algebra before threads compile. JAX imports it when it compiles, which may fail in two threads at a time."""
    import scipy.linalg  # noqa: F401 - JAX calls the LAPACK that SciPy loads


@cache
def _linear_algebra_libraries() -> ThreadpoolController:
    load_linear_algebra()
    return ThreadpoolController()
