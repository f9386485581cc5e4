"""Events that the training process must handle: memory that runs out, and signals to stop."""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator

import jax

from lare_rl.config.train_config import replay_rows
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run

__all__ = ["catch_stop_signals", "report_full_memory"]

STOP_SIGNALS = signal.SIGINT, signal.SIGTERM
SAME_REQUEST_S = 1.0
"""Signals less than this many seconds apart count as one: a terminal and a parent process may each send one."""
UNRESPONSIVE_S = 10.0
"""How long (s) the main thread may take to react to the second signal: a simulator in C may hang in it. Then the process ends."""


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

    old_handlers = {number: signal.signal(number, handle) for number in STOP_SIGNALS}
    try:
        with _end_unresponsive_process():
            yield stop
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not installed by Python


@contextlib.contextmanager
def _end_unresponsive_process() -> Iterator[None]:
    """End the process if the main thread does not react to the second signal.

    Python calls signal handlers in the main thread, between two steps of the interpreter: not while a simulator hangs in C. But it
    writes the number of each signal to a descriptor at once, and another thread reads it there.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    old_descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_wait_for_second_signal, args=(receiver,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(old_descriptor)
        sender.close()


def _wait_for_second_signal(receiver: socket.socket) -> None:
    """End the process `UNRESPONSIVE_S` after the second request to stop, unless the sender is closed before."""
    first_request_at = None
    with receiver:
        while number := receiver.recv(1):
            if number[0] not in STOP_SIGNALS:
                continue
            if first_request_at is None:
                first_request_at = time.monotonic()
            elif time.monotonic() - first_request_at > SAME_REQUEST_S:
                break
        receiver.settimeout(UNRESPONSIVE_S)
        try:
            while receiver.recv(1):
                pass
        except TimeoutError:
            os._exit(130)
