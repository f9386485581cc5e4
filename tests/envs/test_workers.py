"""Environments in worker processes are those in this one, and say in one line how they fail."""

import os
import signal
import subprocess
import sys
import time
from copy import deepcopy
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import lare_rl
from helpers import host_envs
from helpers.host_envs import ToyHostEnv
from helpers.toy_envs import toy_spec
from lare_rl.envs.pettingzoo_env import make
from lare_rl.envs.workers import LocalVecEnv, SubprocVecEnv
from lare_rl.errors import LareError

BOTH = [LocalVecEnv, partial(SubprocVecEnv, processes=2)]


def same(actual, other):
    *arrays, measures = actual
    *other_arrays, other_measures = other
    for first_array, right in zip(arrays, other_arrays, strict=True):
        np.testing.assert_array_equal(first_array, right)
        assert first_array.dtype == right.dtype
    assert measures.keys() == other_measures.keys()
    for name, first_array in measures.items():
        np.testing.assert_array_equal(first_array, other_measures[name])


def walk(envs, steps=3):
    n = len(envs.batch.alive)
    envs.reset(np.ones(n, bool), np.arange(n))
    for _ in range(steps):
        envs.step(np.zeros((n, 2, 2), np.float32))


def test_workers_do_what_is_done_in_one_process():
    chance = np.random.default_rng(0)
    makers = [ToyHostEnv] * 5
    with LocalVecEnv(makers) as near, SubprocVecEnv(makers, processes=2) as far:
        assert os.getpid() not in far.pids
        assert len(set(far.pids)) == 2
        assert far.spec.teams == near.spec.teams
        for _ in range(4):
            where, seeds = chance.random(5) < 0.7, chance.integers(0, 2**31, 5)
            if not near.batch.alive[0].any():
                where[:] = True
            actual, other = near.reset(where, seeds), far.reset(where, seeds)
            assert not other.state.any(), "a worker has imported JAX"
            same(actual._replace(state=other.state), other)
            for _ in range(3):
                action = chance.normal(size=(5, 2, 2)).astype(np.float32)
                where = chance.random(5) < 0.5
                actual, other = near.step(action, where), far.step(action, where)
                same(actual._replace(state=other.state), other)
        same(near.step(action)._replace(state=far.batch.state[:1].repeat(5, 0)), far.step(action))


def test_pettingzoo_in_workers():
    task = toy_spec(
        name="spread",
        environment="pettingzoo/mpe2.simple_spread_v3:parallel_env",
        observation_size=18,
        action_size=5,
    )
    chance = np.random.default_rng(0)
    makers = [partial(make, task)] * 3
    with LocalVecEnv(makers) as near, SubprocVecEnv(makers, processes=2) as far:
        same(near.reset(np.ones(3, bool), np.arange(3)), far.reset(np.ones(3, bool), np.arange(3)))
        for _ in range(25):
            action = np.eye(5, dtype=np.float32)[chance.integers(0, 5, (3, 3))]
            actual, other = near.step(action), far.step(action)
            same(actual, other)
        assert other.truncated.all()


@pytest.mark.parametrize("envs", BOTH)
def test_rows_of_the_others_stay(envs):
    with envs([ToyHostEnv] * 3) as vec_env:
        first = deepcopy(vec_env.reset(np.array([True, False, True]), np.arange(3)))
        assert not first.observation[1].any()
        assert not first.alive[1].any()
        second = deepcopy(vec_env.reset(np.array([False, True, False]), np.array([9, 9, 9])))
        np.testing.assert_array_equal(second.observation[[0, 2]], first.observation[[0, 2]])
        assert second.observation[1].any()
        assert vec_env.batch.observation.shape[1:] == (2, 2)
        third = vec_env.step(np.ones((3, 2, 2), np.float32), np.array([False, False, True]))
        np.testing.assert_array_equal(third.observation[:2], second.observation[:2])
        assert not np.array_equal(third.observation[2], second.observation[2])


@pytest.mark.parametrize("envs", BOTH)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("itself", "the battery is empty"),
        ("error", "environment 1 failed in step: ZeroDivisionError"),
        ("exit", "environment 1 failed in step: the window is closed"),
        ("make", "environment 1 cannot be made: no asset"),
    ],
)
def test_what_an_environment_raises_is_one_line(envs, fault, message):
    with pytest.raises(LareError) as error:
        walk(envs([ToyHostEnv, partial(ToyHostEnv, fault)]))
    assert str(error.value) == message


@pytest.mark.parametrize(("fault", "how"), [("dies", "signal SIGKILL"), ("leaves", "exit status 3")])
def test_a_worker_that_dies(fault, how):
    far = SubprocVecEnv([ToyHostEnv, ToyHostEnv, ToyHostEnv, partial(ToyHostEnv, fault)], processes=2)
    pids = far.pids
    with pytest.raises(LareError) as error:
        walk(far)
    assert str(error.value) == f"environment 3 (in worker process {pids[1]}) died: {how}"
    assert not any(map(runs, pids))
    with pytest.raises(LareError, match="the worker processes have ended"):
        far.step(np.zeros((4, 2, 2), np.float32))


def test_a_worker_that_is_killed_between_steps():
    far = SubprocVecEnv([ToyHostEnv])
    pid = far.pids[0]
    far.reset(np.ones(1, bool), np.arange(1))
    os.kill(pid, signal.SIGKILL)
    while runs(pid):
        time.sleep(0.01)
    with pytest.raises(LareError) as error:
        far.step(np.zeros((1, 2, 2), np.float32))
    assert str(error.value) == f"environment 0 (in worker process {pid}) died: signal SIGKILL"


def test_a_worker_that_hangs():
    far = SubprocVecEnv([ToyHostEnv, ToyHostEnv, partial(ToyHostEnv, "hangs"), ToyHostEnv], processes=2)
    pid = far.pids[0]
    walk(far, steps=2)
    far.timeout = 0.5
    with pytest.raises(LareError) as error:
        far.step(np.zeros((4, 2, 2), np.float32))
    assert str(error.value) == f"environment 2 (in worker process {pid}) did not reply for 0.5 s in step"
    assert not runs(pid)


def test_closing_closes_the_environments(tmp_path):
    notes = [tmp_path / name for name in ("one", "two")]
    far = SubprocVecEnv([partial(ToyHostEnv, note=str(note)) for note in notes], processes=1)
    pid = far.pids[0]
    far.close()
    assert [note.read_text() for note in notes] == ["closed", "closed"]
    assert not runs(pid)
    far.close()


def test_environments_must_be_alike():
    with pytest.raises(LareError, match=r"^environment 1 differs from environment 0: .* 3, .*, not .* 2, "):
        LocalVecEnv([ToyHostEnv, partial(ToyHostEnv, size=3)])


def test_what_cannot_be_sent():
    with pytest.raises(LareError, match=r"^environment 0 cannot be sent to a worker process: .*lambda"):
        SubprocVecEnv([lambda: ToyHostEnv()])


PROGRAM = """
import os, signal, sys, time
from functools import partial
import numpy as np
from helpers.host_envs import ToyHostEnv
from lare_rl.envs.workers import SubprocVecEnv

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
far = SubprocVecEnv([partial(ToyHostEnv, seconds=0.05)] * 2, processes=2)
print(*far.pids, flush=True)
far.reset(np.ones(2, bool), np.arange(2))
while True:
    far.step(np.zeros((2, 2, 2), np.float32))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent_and_say_nothing(how):
    """The program has no `if __name__ == "__main__"`: workers do not run it again."""
    paths = os.pathsep.join(str(Path(module.__file__).parents[1]) for module in (lare_rl, host_envs))
    parent = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        pids = list(map(int, parent.stdout.readline().split()))
        assert all(map(runs, pids))
        time.sleep(0.2)
        os.killpg(parent.pid, how)  # as a terminal does
        _, error_output = parent.communicate(timeout=30)
    finally:
        parent.kill()
    assert error_output.count("Traceback") == (how == signal.SIGINT)  # the parent's own
    until = time.monotonic() + 10
    while any(map(runs, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(runs, pids))


def runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # Without anybody to wait for it, one that has ended stays in the table.
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"
