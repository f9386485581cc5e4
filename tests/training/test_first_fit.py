"""The first fit of many agents' decoders: what is held out is not fitted to, and the best decoder of each seed is kept."""

import os
import signal
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lare_rl
from helpers.toys import At, figures
from lare_rl.config.resolve import decide
from lare_rl.data import replay
from lare_rl.envs.load import read_task
from lare_rl.latent.function import verified
from lare_rl.runs.directory import create
from lare_rl.training import first_fit, session
from lare_rl.training.compiled import compiled
from lare_rl.training.first_fit import PATIENCE, fit_until_it_stops_helping, held_out, with_smaller_updates
from lare_rl.training.seed_axis import of_seed


def every_step(buffer):
    """All transitions of one seed's replay."""
    return replay.read(buffer, replay.newest(buffer, int(buffer.transitions[0])))


def buffer_of(*episodes):
    """A replay whose environments have so many finished episodes."""
    empty = replay.empty({}, len(episodes), 100, 1)
    return empty._replace(episodes=jnp.array(episodes), running=jnp.zeros(len(episodes), bool))


@pytest.mark.parametrize(
    ("episodes", "held"),
    [
        ((10,), [2]),
        ((1,) * 10, [0] * 8 + [1] * 2),
        ((3, 3, 3, 3), [0, 0, 0, 2]),
        ((4, 0, 6), [0, 0, 2]),
        ((999,), [32]),
    ],
)
def test_a_fifth_is_held_out_and_at_most_as_many_as_are_looked_back_on(episodes, held):
    assert held_out(buffer_of(*episodes)).tolist() == held


PHI = "def evaluation_func(o, a):\n    return [np.sum(np.square(o[:, 4:8]), axis=1, keepdims=True), o[:, 0:1]]"


@pytest.fixture
def begun(small_many, tmp_path):
    """A session with the first episodes of two seeds, before the first fit."""
    task = read_task("CN-6")
    changes = {"environments": 12, "steps": 600, "evaluate_every": 300, "capacity": 2000, "first_fit": "held-out"}
    settings = small_many(method="lare-rd", **changes)
    run = create(tmp_path / "run", task, decide(settings, task), [verified(PHI, task)])
    started = session.start(run)
    steps = started.collector.collect(started.actor, 0)
    started.learner, finite = started.functions.store(started.learner, steps)
    assert np.all(finite)
    yield started
    started.close()


def test_fits_see_no_held_out_episode_and_the_best_decoders_are_kept(begun, monkeypatch):
    errors, seen = [[3.0, 3.0], [1.0, 4.0], [2.0, 2.0], [5.0, 5.0], [0.0, 6.0]], []

    def fit(learner, keys):
        steps = every_step(of_seed(learner.replay))
        # One episode in each of ten environments, as long as it is in the whole replay.
        assert np.asarray(steps.finished).sum() == 10 * 25
        assert set(np.asarray(steps.length[steps.finished]).tolist()) == {25}
        seen.append((np.asarray(learner.replay.episodes).sum(axis=1).tolist(), np.asarray(jax.random.key_data(keys))))
        number = len(seen)
        credit = jax.tree.map(lambda leaf: jnp.full_like(leaf, number), learner.credit)
        return learner._replace(credit=credit), {"credit/loss": jnp.zeros(2)}

    monkeypatch.setattr(first_fit, "error_of", lambda *_, config: jnp.zeros(()))
    monkeypatch.setattr(first_fit.jax, "jit", lambda _: lambda *_: errors[len(seen) - 1])
    keys = jax.random.split(jax.random.key(0), 2)
    before = np.asarray(begun.learner.replay.episodes)
    learner, measured = fit_until_it_stops_helping(begun.learner, fit, keys, begun.config, lambda: False)
    assert len(seen) == 3 + PATIENCE
    assert all(episodes == [10, 10] for episodes, _ in seen)
    assert len({key.tobytes() for _, key in seen}) == len(seen)
    # The first seed has stopped when it would have become better once more.
    kept = np.asarray(jax.tree.leaves(learner.credit)[0])
    assert [set(np.ravel(of_seed)) for of_seed in kept] == [{2.0}, {3.0}]
    np.testing.assert_array_equal(learner.replay.episodes, before)
    np.testing.assert_array_equal(learner.replay.running, np.zeros_like(before, bool))
    assert "credit/loss" in measured


def test_the_first_fit_goes_on_longer_and_only_the_first(begun, monkeypatch):
    fits = []

    def counted(config, phi=()):
        functions = compiled(config, phi)

        def fit(learner, keys):
            fits.append(config.credit.steps)
            return functions.fit(learner, keys)

        return functions._replace(fit=fit)

    monkeypatch.setattr(session, "compiled", counted)
    begun.functions = counted(begun.config)
    keys = jax.random.split(jax.random.key(0), 2)
    begun.fit(keys, lambda: False)
    first = len(fits)
    assert first >= 1 + PATIENCE
    assert set(fits) == {with_smaller_updates(begun.config).credit.steps}
    assert begun.fitted
    begun.fit(keys, lambda: False)
    assert fits[first:] == [begun.config.credit.steps]


@pytest.mark.parametrize(("steps", "first"), [(6400, 800), (400, 50), (150, 25), (20, 20)])
def test_updates_of_the_first_fit_draw_an_eighth_of_the_steps_and_at_least_an_episode(begun, steps, first):
    config = replace(begun.config, credit=begun.config.credit.model_copy(update={"steps": steps}))
    assert with_smaller_updates(config).credit.steps == first


@pytest.mark.long
def test_a_run_that_is_resumed_after_its_first_fit_makes_no_other(small_many, tmp_path):
    task = read_task("CN-6")
    settings = small_many(
        method="lare-rd", seeds=1, environments=12, steps=900, evaluate_every=300, capacity=2000, first_fit="held-out"
    )
    given = {"function": verified(PHI, task)}
    whole = lare_rl.train(task, settings, out=tmp_path / "whole", listeners=[], **given)

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lare_rl.train(task, settings, out=tmp_path / "run", listeners=[At(600, stop)], **given)
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)


def test_a_run_that_is_stopped_during_its_first_fit_begins_again(small_many, tmp_path, monkeypatch):
    task = read_task("CN-6")
    settings = small_many(
        method="lare-rd", seeds=1, environments=12, steps=600, evaluate_every=300, capacity=2000, first_fit="held-out"
    )
    given = {"function": verified(PHI, task)}
    whole = lare_rl.train(task, settings, out=tmp_path / "whole", listeners=[], **given)

    def ask_to_stop(learner):
        os.kill(os.getpid(), signal.SIGINT)
        return True

    with monkeypatch.context() as patch:
        patch.setattr(first_fit, "has_enough", ask_to_stop)
        with pytest.raises(lare_rl.LareError) as stopped:
            lare_rl.train(task, settings, out=tmp_path / "run", listeners=[], **given)
    said = f"stopped during the decoder's first fit; to continue: lare-rl train --resume {tmp_path / 'run'}"
    assert str(stopped.value) == said
    assert figures(lare_rl.resume(tmp_path / "run", listeners=[])) == figures(whole)
