"""Reflection in the middle of a run: a better phi takes its place, exactly, and nothing that goes wrong hurts the run."""

import json
import signal

import jax
import numpy as np
import pytest

import lare_rl
from helpers.toys import At, Ear, Says, figures, toy_spec
from lare_rl.data.replay import oldest_transition
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent.function import verified
from lare_rl.llm.recording import RecordedModel, read_recording
from lare_rl.runs.directory import open_run
from lare_rl.training.explain import explanation_of
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner
from lare_rl.training.train import Interrupted

WRONG = "def evaluation_func(observation, action):\n    return [observation[:, 1:2]]"
RIGHT = "def evaluation_func(observation, action):\n    return [np.square(action - observation[:, 0:1]), action]"


@pytest.fixture(autouse=True, scope="module")
def without_pairs():
    """With pairs of entries, raw features nearly make up for the first function."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lare_rl.credit.basis.MOST_PAIRED", 0)
        yield


@pytest.fixture(scope="module")
def settings(small):
    changes = {"steps": 1800, "seeds": 2, "evaluate_every": 300, "reflect_every": 600}
    return small(method="lare-bayes", algorithm="td3", **changes)


def trained(settings, model, out, listeners=()):
    task = toy_spec(judges="before")
    return lare_rl.train(task, settings, function=verified(WRONG, task), model=model, out=out, listeners=listeners)


@pytest.fixture(scope="module")
def renewed(settings, tmp_path_factory):
    """A run whose function was replaced at step 600; what was said, and the model that was asked."""
    ear, model = Ear(), Says(RIGHT, WRONG)
    return trained(settings, model, tmp_path_factory.mktemp("renewed") / "run", [ear]), ear, model


def test_a_better_function_takes_its_place(renewed):
    run, ear, model = renewed
    assert (run.function.source, run.since) == (RIGHT, 600)
    said = [line for line in ear.heard if line.startswith("reflection")]
    assert [line.endswith(("kept", "not better")) for line in said] == [False, True, False, True]
    assert "For each factor: its share" in model.asked[1][-1]["content"]
    before, after = (
        [line["credit/correlation"] for line in run.metrics() if line["step"] == step] for step in (600, 900)
    )
    assert max(before) < 0.95
    assert min(after) > 0.999
    again = open_run(run.directory)
    assert (again.function.source, again.since) == (RIGHT, 600)
    assert "def evaluation_func" in (run.directory / "latent_function-600.py").read_text()
    assert any(line.startswith("The factors explain 100%") for line in explanation_of(again))
    assert len(again.function.exchanges) == 1


def test_the_factors_of_all_stored_steps_are_computed_again(renewed):
    run, _, _ = renewed
    _, learner, _, _ = load_learner(run)
    for seed in range(2):
        buffer = of_seed(learner.replay, seed)
        rows = np.asarray(buffer.row)[0, int(oldest_transition(buffer)[0]) : int(buffer.transitions[0])]
        observation, action, z = (
            np.asarray(buffer.columns[name])[0, rows] for name in ("observation", "action", "factors")
        )
        taken = np.clip(action, -1, 1) * 2
        assert len(rows) == 1800
        np.testing.assert_allclose(
            z[:, 0], np.concatenate([(taken - observation[..., :1])[:, 0] ** 2, taken[:, 0]], 1), atol=1e-5
        )


@pytest.mark.long
def test_a_run_that_is_stopped_after_a_reflection_goes_on_bit_for_bit(settings, renewed, tmp_path):
    whole, _, _ = renewed
    with pytest.raises(Interrupted):
        trained(settings, Says(RIGHT), tmp_path / "run", [At(708, lambda: signal.raise_signal(signal.SIGINT))])
    assert figures(lare_rl.resume(tmp_path / "run", model=Says(WRONG), listeners=[])) == figures(whole)


@pytest.mark.long
def test_what_was_recorded_answers_again(settings, renewed, tmp_path):
    """A recording of the exchanges of one run is the model of another, which is the same."""
    first, _, _ = renewed
    talk = {
        "task": "Chase",
        "kind": "factors",
        "draw": 0,
        "model": "says",
        "recorded": "2026-01-01",
        "temperature": None,
    }
    text = json.dumps(talk | {"exchanges": list(first.function.exchanges)})
    second = trained(settings, RecordedModel([read_recording(text, "talk.json")], "Chase"), tmp_path / "second")
    assert figures(second) == figures(first)


def test_a_model_that_has_left_does_not_end_the_run(settings, tmp_path):
    ear = Ear()
    run = trained(settings, Says(), tmp_path / "run", [ear])
    assert (run.function.source, run.since) == (WRONG, 0)
    assert "reflection 1: nobody there" in ear.heard
    assert run.metrics()[-1]["step"] == 1800


def test_where_few_episodes_have_finished_nothing_is_asked(settings, tmp_path):
    ear, model = Ear(), Says(RIGHT)
    asked = settings.model_copy(update={"steps": 240, "evaluate_every": 60, "reflect_every": 120})
    trained(asked, model, tmp_path / "run", [ear])
    assert "no reflection: 12 episodes say too little of a function: 20 are needed" in ear.heard
    assert model.asked == []


def test_many_agents(small_many, tmp_path):
    task = read_task("CN-6")
    first = "def evaluation_func(o, a):\n    return [o[:, 0:1] * a[:, 0:1]]"
    better = "def evaluation_func(o, a):\n    return [np.sum(np.square(o[:, 4:8]), axis=1, keepdims=True), o[:, 0:1], o[:, 1:2]]"
    asked = small_many(method="lare-bayes", seeds=1, steps=400, evaluate_every=200, reflect_every=200, capacity=2000)
    ear = Ear()
    run = lare_rl.train(
        task, asked, function=verified(first, task), model=Says(better), out=tmp_path / "run", listeners=[ear]
    )
    _, learner, _, _ = load_learner(run)
    assert learner.replay.columns["factors"].shape[-1] == (3 if run.since else 1)
    assert np.all(np.isfinite(jax.tree.leaves(learner.credit)[0]))
    assert run.metrics()[-1]["step"] == 400


@pytest.mark.parametrize(
    ("changes", "model", "message"),
    [
        (
            {"method": "lare-linear"},
            Says(),
            "reflect_every is for lare-bayes, whose decoder is fitted at once when phi changes; the ",
        ),
        ({"reflect_every": 100}, Says(), "reflect_every = 100 is not a multiple of rollout_steps = 12: take 96"),
        ({}, None, "reflect_every asks a language model: say which one with --model NAME (model=... in Python)"),
        (
            {"reflect_every": None},
            Says(),
            "a model is given, and nothing asks it: say how often with --reflect-every STEPS",
        ),
    ],
)
def test_what_does_not_go_together(settings, changes, model, message, tmp_path):
    with pytest.raises(
        LareError, match="^" + message.replace("(", r"\(").replace(")", r"\)").replace("...", r"\.\.\.")
    ):
        trained(settings.model_copy(update=changes), model, tmp_path / "run")
    assert not (tmp_path / "run").exists()
