"""Short training runs without a terminal: trained, stopped, copied and resumed (`from helpers.training_runs import ...`)."""

import shutil
import signal

import numpy as np
import pytest

import lare_rl
from helpers.listeners import AtStep, metrics_without_times
from helpers.toy_envs import toy_spec
from lare_rl.runs.directory import open_run
from lare_rl.training.train import RunInterruptedError

QUICK_CREDIT = {"hidden": (8,), "sampled_steps": 4, "batch_steps": 16, "score": "sum"}
"""To find out the type of the score would take seconds of compilation."""

CHASE = toy_spec(measures=("distance",))

ECHO_PHI = "def evaluation_func(o, a):\n    return [np.sum(o[:, :3] * a, axis=1, keepdims=True), o[:, 3:4]]\n"


def train_quietly(task, settings, out, function=None, listeners=(), **arguments):
    return lare_rl.train(task, settings, function=function, out=out, listeners=list(listeners), **arguments)


def resume_quietly(run, **arguments):
    return lare_rl.resume(run, **({"listeners": []} | arguments))


def copy_run(run, directory):
    return open_run(shutil.copytree(run.directory, directory))


def train_and_stop(task, settings, out, step, function=None, signal_number=signal.SIGINT):
    """Train until a signal stops the run after `step`, and return the error."""
    stop = AtStep(step, lambda: signal.raise_signal(signal_number))
    with pytest.raises(RunInterruptedError) as caught:
        train_quietly(task, settings, out, function, [stop])
    return caught.value


def assert_equal_runs(run, other):
    """Assert that two runs have the same metrics, checkpoint and best policy, bit for bit."""
    assert metrics_without_times(run) == metrics_without_times(other)
    best = ["best.npz"] if len(run.config.task.roles) == 1 else []  # several teams have no best policies
    for file in ("state.npz", *best):
        with np.load(run.checkpoint / file) as a, np.load(other.checkpoint / file) as b:
            assert set(a.files) == set(b.files)
            for name in set(a.files) - {"host", "segments"}:
                np.testing.assert_array_equal(a[name], b[name], err_msg=name)
