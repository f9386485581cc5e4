"""Simulators that allow one simulation in a process get processes of their own, which are watched and kept."""

import contextlib
import os

import numpy as np
import pytest

from helpers.single_instance import N_STEPS, simulations, single_spec
from helpers.toy_envs import toy_spec
from lare_rl.envs import placement, workers
from lare_rl.envs.placement import (
    load_env_spec,
    make_host_env,
    make_vec_env,
    measure_step_s,
    n_open_envs,
    needs_process,
)
from lare_rl.envs.play import play_episodes
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.envs.workers import close_idle_workers
from lare_rl.errors import LareError
from lare_rl.latent.verify import random_steps


@pytest.fixture(autouse=True)
def no_idle_workers():
    yield
    close_idle_workers()


@pytest.fixture(autouse=True)
def no_other_environment_is_slow(monkeypatch):
    """Leave out measured times, however loaded the machine is. The slow environment of these tests needs 5 ms."""
    monkeypatch.setattr(placement, "SLOW_STEP_S", 1.0)
    monkeypatch.setattr(placement, "SLOW_START_S", 60.0)


@pytest.fixture
def starts(tmp_path, monkeypatch):
    """Return a function that returns the processes in which simulations have started."""
    path = tmp_path / "starts"
    monkeypatch.setenv("STARTS_FILE", str(path))
    return lambda: list(map(int, path.read_text().split()))


def step_all(envs):
    n = len(envs.batch.terminated)
    observation = envs.reset(np.ones(n, bool), np.arange(n)).observation.copy()
    return observation, envs.step(np.tile(np.eye(1, 3, dtype=np.float32), (n, 1, 1))).observation.copy()


@pytest.mark.parametrize(
    ("name", "separate"), [("Fails", True), ("Hangs", True), ("Shares", True), ("Slow", True), ("Many", False)]
)
def test_a_second_simulation_is_tried(name, separate, monkeypatch):
    if name == "Slow":
        monkeypatch.setattr(placement, "SLOW_STEP_S", 0.002)
    if name == "Hangs":
        monkeypatch.setattr(placement, "INTERFERENCE_TIMEOUT_S", 1.5)
    task = single_spec(name)
    assert needs_process(task) == separate
    assert not simulations
    if name in ("Shares", "Many"):
        for module in (placement, workers):
            monkeypatch.setattr(module, "n_usable_cores", lambda: 2)
        monkeypatch.setattr(placement, "measure_step_s", lambda task: 1.0)  # so slow that two processes save time
        with make_vec_env(task, 2) as envs:
            assert len(set(envs.pids)) == 2
            observation, moved = step_all(envs)
        np.testing.assert_allclose(moved, 0.9 * observation - 0.1, rtol=1e-5)
    if name == "Slow":
        assert measure_step_s(task) > 0.004


def test_familiar_packages_and_scripts_share_a_process(monkeypatch):
    monkeypatch.setattr(placement, "_fails_trial", lambda task: pytest.fail("tried"))
    pendulum = toy_spec(name="p", environment="Pendulum-v1", observation_size=3)
    spread = toy_spec(
        name="s", environment="pettingzoo/mpe2.simple_spread_v3:parallel_env", observation_size=18, action_size=5
    )
    for task in (toy_spec(), pendulum, spread):  # the class of the toy is registered by this process
        assert not needs_process(task)
    with make_vec_env(toy_spec(), 1) as envs:
        assert isinstance(envs, LocalVecEnv)


def test_separate_by_the_task_file_starts_once(starts, tmp_path):
    """The first look at the spaces, the steps for verification, a measurement, episodes and a batch share one simulation."""
    task = single_spec("Fails", processes="separate", timeout=7.0)
    assert load_env_spec(task).max_steps == N_STEPS
    with contextlib.closing(make_host_env(task)) as env, pytest.raises(LareError, match="cannot be drawn"):
        env.render()
    random_steps(task)
    assert measure_step_s(task) > 0
    episodes = play_episodes(task, 2)
    assert [len(episode.reward) for episode in episodes] == [N_STEPS] * 2
    with make_vec_env(task, 1) as training:
        assert (starts(), training.timeout) == (training.pids, 7.0)
        with make_vec_env(task, 2) as evaluation:
            assert sorted(starts()) == sorted(training.pids + evaluation.pids)
    assert os.getpid() not in starts()
    close_idle_workers()
    assert len(starts()) == 3


def test_few_simulations_are_open_at_a_time(monkeypatch):
    monkeypatch.setattr(placement, "n_usable_cores", lambda: 4)
    separate = single_spec("Many", processes="separate")
    assert [n_open_envs(separate, n_seeds, 10) for n_seeds in (1, 2, 3, 9)] == [4, 2, 1, 1]
    assert n_open_envs(separate, 1, 3) == 3
    assert n_open_envs(toy_spec(), 2, 10) == 10
