"""Calculations in float64, for fits in closed form."""

import contextlib
from collections.abc import Iterator

import jax

from lare_rl.errors import LareError
from lare_rl.util.blas import load_linear_algebra, one_blas_thread

__all__ = ["float64", "require_float32"]


@contextlib.contextmanager
def float64() -> Iterator[None]:
    """Let JAX calculate and trace in float64, and linear algebra use one thread. Wait for results before the block ends."""
    load_linear_algebra()
    with jax.enable_x64(True), one_blas_thread():
        yield


def require_float32() -> None:
    """Raise `LareError` if JAX calculates in float64 everywhere."""
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue] - JAX makes it at run time
        raise LareError(
            "JAX calculates in float64 here (jax_enable_x64, or JAX_ENABLE_X64), and LaRe trains in float32: switch it off"
        )
