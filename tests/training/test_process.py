"""Requests to stop."""

import signal

import pytest

from lare_rl.training import process


def test_signals_in_quick_succession_are_one_request(monkeypatch, capfd):
    before = signal.getsignal(signal.SIGINT)
    with process.stop_requests() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stop.is_set()
        assert capfd.readouterr().err.count("stopping after this iteration") == 1
        monkeypatch.setattr(process, "ONE_REQUEST", 0.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
