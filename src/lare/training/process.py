"""Events that the training process must handle: memory that runs out, and requests to stop."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

import jax

from lare.errors import LareError
from lare.run.directory import Run


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
    """An event that the first Ctrl-C or SIGTERM sets, which is said on standard error. The second one ends the process at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may set signal handlers
        return

    def handle(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        with contextlib.suppress(OSError):
            os.write(2, b"\nstopping after this iteration (a second Ctrl-C or SIGTERM ends it at once)\n")

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
