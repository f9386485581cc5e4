"""Runs whose environments are in processes of their own."""

import pytest

from helpers.listeners import MessageListener
from helpers.single_instance import N_STEPS, simulations, single_spec
from helpers.training_runs import assert_equal_runs, resume_quietly, train_and_stop, train_quietly
from lare_rl.envs import placement
from lare_rl.envs.workers import _idle_workers
from lare_rl.training import train as training

SEPARATE = single_spec("Fails", processes="separate")


@pytest.fixture
def settings(small):
    return small(
        algorithm="ppo", method="dense", steps=60, rollout_steps=10, evaluate_every=30, evaluation_episodes=3, seeds=2
    )


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(placement, "SLOW_STEP_S", 1.0)  # however loaded the machine is
    monkeypatch.setattr(placement, "n_usable_cores", lambda: 2)


@pytest.mark.long
def test_run_equals_one_in_a_single_process(settings, tmp_path, monkeypatch):
    """Bit for bit, after a stop. Each simulation is started once: the training environment and one for evaluations, of each seed.

    Listeners hear of every step, also inside an iteration and during an evaluation.
    """
    steps, listener = [], MessageListener()
    listener.on_step = steps.append
    with monkeypatch.context() as patch:
        patch.setattr(training, "PROGRESS_S", -1.0)
        local = train_quietly(single_spec("Many"), settings, tmp_path / "local", listeners=[listener])
    assert [step for step in steps if step <= 10] == [*range(1, 11), 10]
    assert steps.count(30) == 1 + 1 + N_STEPS  # the last step, the iteration, and each step of the evaluation
    monkeypatch.setenv("STARTS_FILE", str(tmp_path / "starts"))
    train_and_stop(SEPARATE, settings, tmp_path / "separate", 40)
    pids = (tmp_path / "starts").read_text().split()
    assert len(pids) == len(set(pids)) == 4
    assert_equal_runs(resume_quietly(tmp_path / "separate"), local)
    assert not simulations
    assert not any(_idle_workers.values())
