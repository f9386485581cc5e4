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

from helpers import hosts
from helpers.hosts import Host
from helpers.toys import toy_spec
from lare_rl.envs.pettingzoo_env import make
from lare_rl.envs.workers import LocalEnvs, WorkerEnvs
from lare_rl.errors import LareError

BOTH = [LocalEnvs, partial(WorkerEnvs, processes=2)]


def same(one, other):
    *arrays, measures = one
    *others, other_measures = other
    for left, right in zip(arrays, others, strict=True):
        np.testing.assert_array_equal(left, right)
        assert left.dtype == right.dtype
    assert measures.keys() == other_measures.keys()
    for name, left in measures.items():
        np.testing.assert_array_equal(left, other_measures[name])


def walk(envs, steps=3):
    n = len(envs.batch.alive)
    envs.reset(np.ones(n, bool), np.arange(n))
    for _ in range(steps):
        envs.step(np.zeros((n, 2, 2), np.float32))


def test_workers_do_what_is_done_in_one_process():
    chance = np.random.default_rng(0)
    makers = [Host] * 5
    with LocalEnvs(makers) as near, WorkerEnvs(makers, processes=2) as far:
        assert {worker.process.pid for worker in far.workers}.isdisjoint({os.getpid()})
        assert [list(worker.places) for worker in far.workers] == [[0, 2, 4], [1, 3]]
        assert far.spec.teams == near.spec.teams
        for _ in range(4):
            where, seeds = chance.random(5) < 0.7, chance.integers(0, 2**31, 5)
            if not near.batch.alive[0].any():
                where[:] = True
            one, other = near.reset(where, seeds), far.reset(where, seeds)
            assert not other.state.any(), "a worker has imported JAX"
            same(one._replace(state=other.state), other)
            for _ in range(3):
                action = chance.normal(size=(5, 2, 2)).astype(np.float32)
                where = chance.random(5) < 0.5
                one, other = near.step(action, where), far.step(action, where)
                same(one._replace(state=other.state), other)
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
    with LocalEnvs(makers) as near, WorkerEnvs(makers, processes=2) as far:
        same(near.reset(np.ones(3, bool), np.arange(3)), far.reset(np.ones(3, bool), np.arange(3)))
        for _ in range(25):
            action = np.eye(5, dtype=np.float32)[chance.integers(0, 5, (3, 3))]
            one, other = near.step(action), far.step(action)
            same(one, other)
        assert other.truncated.all()


@pytest.mark.parametrize("envs", BOTH)
def test_rows_of_the_others_stay(envs):
    with envs([Host] * 3) as made:
        first = deepcopy(made.reset(np.array([True, False, True]), np.arange(3)))
        assert not first.observation[1].any()
        assert not first.alive[1].any()
        second = deepcopy(made.reset(np.array([False, True, False]), np.array([9, 9, 9])))
        np.testing.assert_array_equal(second.observation[[0, 2]], first.observation[[0, 2]])
        assert second.observation[1].any()
        assert made.batch.observation.shape[1:] == (2, 2)
        third = made.step(np.ones((3, 2, 2), np.float32), np.array([False, False, True]))
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
        walk(envs([Host, partial(Host, fault)]))
    assert str(error.value) == message


@pytest.mark.parametrize(("fault", "how"), [("dies", "signal SIGKILL"), ("leaves", "exit status 3")])
def test_a_worker_that_dies(fault, how):
    far = WorkerEnvs([Host, Host, Host, partial(Host, fault)], processes=2)
    pids = [worker.process.pid for worker in far.workers]
    with pytest.raises(LareError) as error:
        walk(far)
    assert str(error.value) == f"environment 3 (in worker process {pids[1]}) died: {how}"
    assert not any(map(runs, pids))
    with pytest.raises(LareError, match="the worker processes have ended: make the environments again"):
        far.step(np.zeros((4, 2, 2), np.float32))


def test_a_worker_that_is_killed_between_steps():
    far = WorkerEnvs([Host])
    pid = far.workers[0].process.pid
    far.reset(np.ones(1, bool), np.arange(1))
    os.kill(pid, signal.SIGKILL)
    far.workers[0].process.wait()
    with pytest.raises(LareError) as error:
        far.step(np.zeros((1, 2, 2), np.float32))
    assert str(error.value) == f"environment 0 (in worker process {pid}) died: signal SIGKILL"


def test_a_worker_that_hangs():
    far = WorkerEnvs([Host, Host, partial(Host, "hangs"), Host], processes=2)
    pid = far.workers[0].process.pid
    walk(far, steps=2)
    far.timeout = 0.5
    with pytest.raises(LareError) as error:
        far.step(np.zeros((4, 2, 2), np.float32))
    assert str(error.value) == f"environment 2 (in worker process {pid}) did not answer for 0.5 s in step"
    assert not runs(pid)


def test_closing_closes_the_environments(tmp_path):
    notes = [tmp_path / name for name in ("one", "two")]
    far = WorkerEnvs([partial(Host, note=str(note)) for note in notes], processes=1)
    pid = far.workers[0].process.pid
    far.close()
    assert [note.read_text() for note in notes] == ["closed", "closed"]
    assert not runs(pid)
    far.close()


def test_environments_must_be_alike():
    with pytest.raises(LareError, match=r"^environment 1 is not like environment 0: .* 3, .*, not .* 2, "):
        LocalEnvs([Host, partial(Host, size=3)])


def test_what_cannot_be_sent():
    with pytest.raises(LareError, match=r"^environment 0 cannot be sent to a worker process: .*lambda"):
        WorkerEnvs([lambda: Host()])


PROGRAM = """
import os, signal, sys, time
from functools import partial
import numpy as np
from helpers.hosts import Host
from lare_rl.envs.workers import WorkerEnvs

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
far = WorkerEnvs([partial(Host, seconds=0.05)] * 2, processes=2)
print(*[worker.process.pid for worker in far.workers], flush=True)
far.reset(np.ones(2, bool), np.arange(2))
while True:
    far.step(np.zeros((2, 2, 2), np.float32))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent_and_say_nothing(how):
    """The program has no `if __name__ == "__main__"`: workers do not run it again."""
    paths = os.pathsep.join(str(Path(module.__file__).parents[1]) for module in (lare_rl, hosts))
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
        _, said = parent.communicate(timeout=30)
    finally:
        parent.kill()
    assert said.count("Traceback") == (how == signal.SIGINT)  # the parent's own
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
