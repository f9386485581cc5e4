"""The first fit of many agents' decoders: held-out episodes are not fitted to, and each seed keeps its best decoder."""

import os
import signal
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.listeners import AtStep, metrics_without_times
from lare_rl.config.resolve import resolve
from lare_rl.data import replay
from lare_rl.envs.load import read_task
from lare_rl.latent.function import verify_function
from lare_rl.runs.directory import create_run
from lare_rl.training import first_fit, session
from lare_rl.training.first_fit import PATIENCE, config_of_first_fit, fit_until_converged
from lare_rl.training.seed_axis import select_seed

PHI = "def evaluation_func(o, a):\n    return [np.sum(np.square(o[:, 4:8]), axis=1, keepdims=True), o[:, 0:1]]"


@pytest.mark.parametrize(
    ("n_episodes", "n_held_out"),
    [
        ((10,), [2]),
        ((1,) * 10, [0] * 8 + [1] * 2),
        ((3, 3, 3, 3), [0, 0, 0, 2]),
        ((4, 0, 6), [0, 0, 2]),
        ((999,), [32]),
    ],
)
def test_count_held_out(n_episodes, n_held_out):
    buffer = replay.init_replay({}, len(n_episodes), 100, 1)._replace(episodes=jnp.array(n_episodes))
    assert first_fit._count_held_out(buffer).tolist() == n_held_out


@pytest.fixture
def started(small_many, tmp_path):
    """A session with the first episodes of two seeds, before the first fit."""
    task = read_task("CN-6")
    changes = {"environments": 12, "steps": 600, "evaluate_every": 300, "capacity": 2000, "first_fit": "held-out"}
    settings = small_many(method="lare-rd", **changes)
    run = create_run(tmp_path / "run", task, resolve(settings, task), [verify_function(PHI, task)])
    started = session.start_session(run)
    steps = started.collector.collect(started.actor, 0)
    started.learner, is_finite = started.functions.store(started.learner, steps)
    assert np.all(is_finite)
    yield started
    started.close()


def test_fit_until_converged_keeps_the_best_decoders(started, monkeypatch):
    errors, rounds = [[3.0, 3.0], [1.0, 4.0], [2.0, 2.0], [5.0, 5.0], [0.0, 6.0]], []

    def fit(learner, keys):
        buffer = select_seed(learner.replay)
        steps = replay.read(buffer, replay.newest_steps(buffer, int(buffer.transitions[0])))
        # One episode in each of ten environments is not held out, and as long as in the whole replay.
        assert np.asarray(steps.finished).sum() == 10 * 25
        assert set(np.asarray(steps.length[steps.finished]).tolist()) == {25}
        rounds.append((np.asarray(learner.replay.episodes).sum(axis=1).tolist(), np.asarray(jax.random.key_data(keys))))
        decoders = jax.tree.map(lambda leaf: jnp.full_like(leaf, len(rounds)), learner.credit)
        return learner._replace(credit=decoders), {"credit/loss": jnp.zeros(2)}

    monkeypatch.setattr(first_fit.jax, "jit", lambda _: lambda *_: errors[len(rounds) - 1])
    keys = jax.random.split(jax.random.key(0), 2)
    n_before = np.asarray(started.learner.replay.episodes)
    learner, metrics = fit_until_converged(started.learner, fit, keys, started.config, lambda: False)
    assert len(rounds) == 3 + PATIENCE
    assert all(n_episodes == [10, 10] for n_episodes, _ in rounds)
    assert len({key.tobytes() for _, key in rounds}) == len(rounds)
    # The first seed has stopped before its error would have fallen again.
    best = np.asarray(jax.tree.leaves(learner.credit)[0])
    assert [set(np.ravel(seed)) for seed in best] == [{2.0}, {3.0}]
    np.testing.assert_array_equal(learner.replay.episodes, n_before)
    np.testing.assert_array_equal(learner.replay.running, np.zeros_like(n_before, bool))
    assert "credit/loss" in metrics


@pytest.mark.parametrize(("steps", "first"), [(6400, 800), (400, 50), (150, 25), (20, 20)])
def test_config_of_first_fit_reads_an_eighth_of_the_steps(started, steps, first):
    config = replace(started.config, credit=started.config.credit.model_copy(update={"steps": steps}))
    assert config_of_first_fit(config).credit.steps == first


def train(task, settings, out, **kwargs):
    return lare_rl.train(task, settings, function=verify_function(PHI, task), out=out, **kwargs)


@pytest.mark.long
def test_resume_after_the_first_fit_makes_no_other(small_many, tmp_path):
    task = read_task("CN-6")
    settings = small_many(
        method="lare-rd", seeds=1, environments=12, steps=900, evaluate_every=300, capacity=2000, first_fit="held-out"
    )
    uninterrupted = train(task, settings, tmp_path / "uninterrupted", listeners=[])

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(task, settings, tmp_path / "run", listeners=[AtStep(600, stop)])
    resumed = lare_rl.resume(tmp_path / "run", listeners=[])
    assert metrics_without_times(resumed) == metrics_without_times(uninterrupted)


def test_resume_after_a_stop_during_the_first_fit(small_many, tmp_path, monkeypatch):
    task = read_task("CN-6")
    settings = small_many(
        method="lare-rd", seeds=1, environments=12, steps=600, evaluate_every=300, capacity=2000, first_fit="held-out"
    )
    uninterrupted = train(task, settings, tmp_path / "uninterrupted", listeners=[])

    def request_stop(learner):
        os.kill(os.getpid(), signal.SIGINT)
        return True

    with monkeypatch.context() as patch:
        patch.setattr(first_fit, "has_enough_episodes", request_stop)
        with pytest.raises(lare_rl.LareError, match=r"first fit.*--resume"):
            train(task, settings, tmp_path / "run", listeners=[])
    resumed = lare_rl.resume(tmp_path / "run", listeners=[])
    assert metrics_without_times(resumed) == metrics_without_times(uninterrupted)
