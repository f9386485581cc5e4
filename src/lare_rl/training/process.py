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
"""The process ends if the main thread has not reacted to the second signal for so long (s): a simulator in C may hang in it."""


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
            signal.signal(number, handler)


@contextlib.contextmanager
def _end_unresponsive_process() -> Iterator[None]:
    """End the process if the main thread does not react to the second signal.

    Python calls its handlers in the main thread, between two steps of the interpreter. So they are not called while a simulator
    hangs in C. A thread reads the numbers of the signals, which Python writes at once.
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
    """Wait until the sender is closed, or end the process some seconds after the second request to stop."""
    first_request = None
    with receiver:
        while number := receiver.recv(1):
            if number[0] not in STOP_SIGNALS:
                continue
            if first_request is None:
                first_request = time.monotonic()
            elif time.monotonic() - first_request > SAME_REQUEST_S:
                break
        receiver.settimeout(UNRESPONSIVE_S)
        try:
            while receiver.recv(1):
                pass
        except TimeoutError:
            os._exit(130)
