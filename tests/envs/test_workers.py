"""Environments in worker processes equal those in this process, and their failures are errors of one line."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from copy import deepcopy
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import lare_rl
from helpers import host_envs
from helpers.host_envs import ToyHostEnv
from lare_rl.envs import workers
from lare_rl.envs.shared_arrays import open_shared_memory
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.envs.workers import SubprocVecEnv
from lare_rl.errors import LareError


def assert_equal(actual, expected) -> None:
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), actual, expected)


def walk(envs, steps=3):
    n = len(envs.batch.alive)
    envs.reset(np.ones(n, bool), np.arange(n))
    for _ in range(steps):
        envs.step(np.zeros((n, 2, 2), np.float32))


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A process that has ended stays in the table until its parent waits for it.
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"


def wait_for_end(pid):
    deadline = time.monotonic() + 30
    while is_running(pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_workers_equal_one_process():
    rng = np.random.default_rng(0)
    makers = [partial(ToyHostEnv, changes={"max_steps": 20})] * 5  # some are stepped after their end
    with LocalVecEnv(makers) as local, SubprocVecEnv(makers, processes=2, timeout=60.0) as remote:
        assert os.getpid() not in remote.pids
        assert len(set(remote.pids)) == 2
        assert remote.spec.teams == local.spec.teams
        for attempt in range(4):
            where, seeds = (rng.random(5) < 0.7) | (attempt == 0), rng.integers(0, 2**31, 5)
            expected, actual = local.reset(where, seeds), remote.reset(where, seeds)
            assert not actual.state.any(), "a worker has imported JAX"
            assert_equal(actual, expected._replace(state=actual.state))
            for where in (rng.random(5) < 0.5, None):
                action = rng.normal(size=(5, 2, 2)).astype(np.float32)
                expected, actual = local.step(action, where), remote.step(action, where)
                assert_equal(actual, expected._replace(state=actual.state))


def test_other_rows_do_not_change():
    with LocalVecEnv([ToyHostEnv] * 3) as envs:
        first = deepcopy(envs.reset(np.array([True, False, True]), np.arange(3)))
        assert not first.observation[1].any()
        assert not first.alive[1].any()
        second = deepcopy(envs.reset(np.array([False, True, False]), np.array([9, 9, 9])))
        np.testing.assert_array_equal(second.observation[[0, 2]], first.observation[[0, 2]])
        assert second.observation[1].any()
        third = envs.step(np.ones((3, 2, 2), np.float32), np.array([False, False, True]))
        np.testing.assert_array_equal(third.observation[:2], second.observation[:2])
        assert not np.array_equal(third.observation[2], second.observation[2])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"max_steps": 2}, "has 2 steps.*max_steps is 2"),
        ({"max_steps": 6, "fixed_length": True}, "5 steps.*fixed_length.*6"),
    ],
)
def test_length_of_an_episode_is_checked(changes, words):
    with LocalVecEnv([partial(ToyHostEnv, changes=changes)] * 2) as envs, pytest.raises(LareError, match=words):
        walk(envs, steps=5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation": np.zeros(2)}, "observation of reset has the shape (2,), not (2, 2)"),
        ({"observation": np.float32([[0, 0], [0, np.nan]])}, "the observation of agent 1 contains nan in entry 1"),
        ({"measures": {"goal": np.array(1)}}, "the measure 'goal' is not in EnvSpec.measures"),
        (None, "reset must return a Timestep, not None"),
    ],
)
def test_timestep_is_checked(changes, message):
    class Broken(ToyHostEnv):
        def timestep(self, reward):
            return None if changes is None else super().timestep(reward)._replace(**changes)

    with LocalVecEnv([ToyHostEnv, Broken]) as envs, pytest.raises(LareError) as error:
        walk(envs)
    assert (str(error.value), error.value.env_index) == (f"the environment: {message}", 1)


@pytest.mark.parametrize("make_vec_env", [LocalVecEnv, partial(SubprocVecEnv, processes=1, timeout=60.0)])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("itself", "the battery is empty"),
        ("exit", "environment 1 failed in step: the window is closed"),
        ("make", "environment 1 cannot be made: no asset track.bin"),
        ("output", "the reward is nan"),
    ],
)
def test_error_of_an_environment(make_vec_env, fault, message):
    with pytest.raises(LareError) as error:
        walk(make_vec_env([ToyHostEnv, partial(ToyHostEnv, fault)]))
    assert str(error.value) == message
    assert getattr(error.value, "env_index", None) == (1 if fault == "output" else None)


@pytest.mark.parametrize(
    ("fault", "timeout", "message"),
    [
        ("dies", 60, "died: signal SIGKILL"),
        ("was killed before", 60, "died: signal SIGKILL"),
        ("hangs", 0.5, "did not reply for 0.5 s in step; if it needs longer, set timeout in the task file"),
        ("hangs", 60, "did not reply for 0.5 s in step; the run was asked to stop, and cannot be saved"),
    ],
)
def test_worker_that_fails(fault, timeout, message, monkeypatch):
    monkeypatch.setattr(workers, "STOP_TIMEOUT_S", 0.5)
    envs = SubprocVecEnv([ToyHostEnv, ToyHostEnv, ToyHostEnv, partial(ToyHostEnv, fault)], processes=2, timeout=60.0)
    pids = envs.pids
    walk(envs, steps=2)
    envs.timeout, envs.stop_requested = timeout, lambda: "asked to stop" in message
    if fault == "was killed before":
        os.kill(pids[1], signal.SIGKILL)
        wait_for_end(pids[1])
    with pytest.raises(LareError) as error:
        envs.step(np.zeros((4, 2, 2), np.float32))
    assert str(error.value) == f"environment 3 (in worker process {pids[1]}) {message}"
    assert not any(map(is_running, pids))
    with pytest.raises(LareError, match="the worker processes have ended"):
        envs.step(np.zeros((4, 2, 2), np.float32))


def test_workers_end_before_their_directory(monkeypatch):
    """One that is just starting would make its socket there, or fail to."""
    processes, ended, start = [], [], subprocess.Popen

    @contextlib.contextmanager
    def watch():
        with open_shared_memory() as memory:
            try:
                yield memory
            finally:
                ended.extend(process.poll() is not None for process in processes)

    monkeypatch.setattr(
        subprocess, "Popen", lambda *args, **kwargs: processes.append(start(*args, **kwargs)) or processes[-1]
    )
    monkeypatch.setattr(workers, "open_shared_memory", watch)
    with pytest.raises(LareError, match=r"^environment 0 cannot be sent to a worker process: .*lambda"):
        SubprocVecEnv([lambda: ToyHostEnv()] * 2, processes=2, timeout=60.0)
    assert ended == [True, True]


class StartsSimulator(ToyHostEnv):
    """Has a simulator in a process of its own, and hangs in a step."""

    def __init__(self, note):
        super().__init__("hangs")
        self.simulator = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        Path(note).write_text(str(self.simulator.pid))


def test_simulator_of_an_environment_ends_with_a_worker_that_hangs(tmp_path):
    envs = SubprocVecEnv([partial(StartsSimulator, tmp_path / "pid")], timeout=60.0)
    envs.timeout = 0.5
    pid = int((tmp_path / "pid").read_text())
    assert is_running(pid)
    with pytest.raises(LareError, match="did not reply"):
        walk(envs)
    envs.close()
    wait_for_end(pid)


def test_close(tmp_path):
    notes = [tmp_path / name for name in ("first", "second")]
    envs = SubprocVecEnv([partial(ToyHostEnv, note=str(note)) for note in notes], processes=1, timeout=60.0)
    pid = envs.pids[0]
    envs.close()
    assert [note.read_text() for note in notes] == ["closed", "closed"]
    assert not is_running(pid)
    envs.close()
    for call in (SubprocVecEnv.measure_step_s, lambda envs: envs.find_interference(ToyHostEnv, 1.0), walk):
        with pytest.raises(LareError, match="the worker processes have ended"):
            call(envs)


def test_environments_are_closed_if_another_is_refused(tmp_path):
    notes = [tmp_path / name for name in ("first", "second")]
    with pytest.raises(LareError, match=r"^environment 2 differs from environment 0: .* 3, .*, not .* 2, "):
        LocalVecEnv([*(partial(ToyHostEnv, note=str(note)) for note in notes), partial(ToyHostEnv, size=3)])
    assert [note.read_text() for note in notes] == ["closed", "closed"]


PROGRAM = """
import os, signal, sys, time
from functools import partial
import numpy as np
from helpers.host_envs import ToyHostEnv
from lare_rl.envs.workers import SubprocVecEnv

signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
envs = SubprocVecEnv([partial(ToyHostEnv, sys.argv[1], seconds=0.05, changes={"max_steps": 10**6})] * 2, processes=2, timeout=60.0)
print(*envs.pids, flush=True)
envs.reset(np.ones(2, bool), np.arange(2))
while True:
    envs.step(np.zeros((2, 2, 2), np.float32))
    print(flush=True)
"""


@pytest.mark.parametrize(("how", "fault"), [(signal.SIGINT, ""), (signal.SIGKILL, "hangs")])
def test_workers_end_silently_with_their_parent(how, fault):
    """The program has no `if __name__ == "__main__"`: workers do not run it again. A step that hangs must end too."""
    paths = os.pathsep.join(str(Path(module.__file__).parents[1]) for module in (lare_rl, host_envs))
    parent = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, fault],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        pids = list(map(int, parent.stdout.readline().split()))
        assert all(map(is_running, pids))
        parent.stdout.readline()
        parent.stdout.readline()
        time.sleep(0.3)  # the third step has begun
        os.killpg(parent.pid, how)  # as a terminal does
        _, error_output = parent.communicate(timeout=30)
    finally:
        parent.kill()
    assert error_output.count("Traceback") == (how == signal.SIGINT)  # only the parent's
    for pid in pids:
        wait_for_end(pid)
