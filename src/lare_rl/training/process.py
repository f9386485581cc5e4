"""Events that the training process must handle: memory that runs out, and requests to stop."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator

import jax

from lare_rl.errors import LareError
from lare_rl.runs.directory import Run

ONE_REQUEST = 1.0
"""Signals within so many seconds are one request: a terminal and a parent process may each send one."""


@contextlib.contextmanager
def enough_memory(run: Run) -> Iterator[None]:
    """Raise `LareError` if memory runs out."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            settings = run.config.settings
            rows = settings.rows(run.config.longest_episode) * settings.environments
            raise LareError(
                f"the memory is full: {settings.seeds} seeds with a replay of {rows:,} rows each; fewer seeds or a smaller "
                "capacity need less"
            ) from error
        raise


@contextlib.contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C or SIGTERM sets, which is said on standard error. A later one ends the process at once."""
    stop, since = threading.Event(), 0.0
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may set signal handlers
        return

    def handle(number: int, frame: object) -> None:
        nonlocal since
        if stop.is_set():
            if time.monotonic() - since > ONE_REQUEST:
                raise KeyboardInterrupt
            return
        since = time.monotonic()
        stop.set()
        with contextlib.suppress(OSError):
            os.write(2, b"\nstopping after this iteration (a second Ctrl-C or SIGTERM ends it at once)\n")

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
