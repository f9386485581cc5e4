"""Signals that stop a run."""

import signal
import subprocess
import sys
import threading
import time

import pytest

from lare_rl.training.process import SAME_REQUEST_S, catch_stop_signals


def test_second_signal_ends_process(monkeypatch, capfd):
    handler, n_threads = signal.getsignal(signal.SIGINT), threading.active_count()
    with catch_stop_signals() as stop:
        assert threading.active_count() == n_threads + 1
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)  # within a moment: the same request
        assert stop.is_set()
        assert capfd.readouterr().err.count("stopping after this iteration") == 1
        later = time.monotonic() + 2 * SAME_REQUEST_S
        monkeypatch.setattr(time, "monotonic", lambda: later)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is handler
    assert signal.set_wakeup_fd(-1) == -1
    for thread in threading.enumerate()[n_threads:]:
        thread.join(10)
    assert threading.active_count() == n_threads


def test_handler_of_an_embedding_program(monkeypatch):
    """Python does not know a handler that was installed in C."""
    handler, install = signal.getsignal(signal.SIGINT), signal.signal
    with monkeypatch.context() as patch:
        patch.setattr(signal, "signal", lambda number, handler: install(number, handler) and None)
        with catch_stop_signals():
            pass
    assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    signal.signal(signal.SIGINT, handler)


PROGRAM = """
import hashlib, lare_rl.training.process as process
process.SAME_REQUEST_S, process.UNRESPONSIVE_S = 0.2, 0.2
with process.catch_stop_signals():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)  # hangs in C
"""


def test_second_signal_ends_process_that_hangs_in_c():
    """The handler of the first signal is never called, because Python calls handlers in the main thread."""
    process = subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE)
    try:
        assert process.stdout.readline() == b"ready\n"
        for pause_s in (0.5, 0.0):
            process.send_signal(signal.SIGTERM)
            time.sleep(pause_s)
        assert process.wait(30) == 130
    finally:
        process.kill()
        process.stdout.close()
