"""Short training runs without a terminal: trained, stopped and resumed (`from helpers.training_runs import ...`)."""

import signal

import numpy as np
import pytest

import lare_rl
from helpers.listeners import AtStep, metrics_without_times
from lare_rl.training.loop import RunInterruptedError


def train_quietly(task, settings, out, function=None, listeners=()):
    return lare_rl.train(task, settings, function=function, out=out, listeners=list(listeners))


def resume_quietly(run, **arguments):
    return lare_rl.resume(run, listeners=[], **arguments)


def train_and_stop(task, settings, out, step, function=None, signal_number=signal.SIGINT):
    """Train until a signal stops the run after `step`, and return the error."""
    stop = AtStep(step, lambda: signal.raise_signal(signal_number))
    with pytest.raises(RunInterruptedError) as caught:
        train_quietly(task, settings, out, function, [stop])
    return caught.value


def assert_equal_runs(run, other):
    """Assert that two runs have the same metrics and the same checkpoint, bit for bit."""
    assert metrics_without_times(run) == metrics_without_times(other)
    with np.load(run.checkpoint / "state.npz") as a, np.load(other.checkpoint / "state.npz") as b:
        assert set(a.files) == set(b.files)
        for name in set(a.files) - {"host", "segments"}:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
