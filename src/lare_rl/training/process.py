"""Events that the training process must handle: memory that runs out, and signals to stop."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator

import jax

from lare_rl.config.resolve import replay_rows
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run

__all__ = ["catch_stop_signals", "report_full_memory"]

SAME_REQUEST_S = 1.0
"""Signals less than this many seconds apart count as one: a terminal and a parent process may each send one."""


@contextlib.contextmanager
def report_full_memory(run: Run) -> Iterator[None]:
    """Raise `LareError` if memory runs out."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            settings = run.config.settings
            n_rows = replay_rows(settings, run.config.longest_episode) * settings.environments
            raise LareError(
                f"the memory is full: {settings.seeds} seeds with a replay of {n_rows:,} rows each; use fewer seeds or a smaller "
                "capacity"
            ) from error
        raise


@contextlib.contextmanager
def catch_stop_signals() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C or SIGTERM sets, with a message. The second signal ends the process at once."""
    stop, stopped_at = threading.Event(), 0.0
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may set signal handlers
        return

    def handle(number: int, frame: object) -> None:
        nonlocal stopped_at
        if stop.is_set():
            if time.monotonic() - stopped_at > SAME_REQUEST_S:
                raise KeyboardInterrupt
            return
        stopped_at = time.monotonic()
        stop.set()
        with contextlib.suppress(OSError):
            os.write(2, b"\nstopping after this iteration (a second Ctrl-C or SIGTERM ends it at once)\n")

    old_handlers = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler)
