"""Signals that stop a run."""

import signal
import time

import pytest

from lare_rl.training.process import SAME_REQUEST_S, catch_stop_signals


def test_second_signal_ends_process(monkeypatch, capfd):
    handler = signal.getsignal(signal.SIGINT)
    with catch_stop_signals() as stop:
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
