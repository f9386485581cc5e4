"""Threads of linear algebra (BLAS and LAPACK), without JAX."""

import contextlib
import sys
import threading
from collections.abc import Iterator
from functools import cache

from threadpoolctl import ThreadpoolController

__all__ = ["load_linear_algebra", "one_blas_thread"]


class _Limit:
    """The limit that all threads of the process share: it begins with the first of them, and ends with the last."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.n_users = 0
        self.opened = contextlib.ExitStack()


_LIMIT = _Limit()


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let linear algebra use one thread, in all threads of the process. Wait for results before the block ends.

    The matrices of a fit are small. Several threads would wait for each other in busy loops: on cores that have other work, a fit
    then takes a hundred times as long.
    """
    with _LIMIT.lock:
        if not _LIMIT.n_users:
            libraries = _libraries("scipy.linalg" in sys.modules)
            _LIMIT.opened.enter_context(libraries.limit(limits=1, user_api="blas"))
        _LIMIT.n_users += 1
    try:
        yield
    finally:
        with _LIMIT.lock:
            _LIMIT.n_users -= 1
            if not _LIMIT.n_users:
                _LIMIT.opened.close()


def load_linear_algebra() -> None:
    """Import SciPy's linear algebra before threads compile. JAX imports it when it compiles, which may fail in two threads at a time."""
    import scipy.linalg  # noqa: F401 - JAX calls the LAPACK that SciPy loads


@cache
def _libraries(has_scipy: bool) -> ThreadpoolController:
    """Find the libraries that are loaded now. They are others once SciPy has its own (`has_scipy`)."""
    return ThreadpoolController()
