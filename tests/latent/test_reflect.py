"""Reflection: what episodes say of a function, and that the better predictor of returns is kept."""

import json

import gymnasium
import numpy as np
import pytest

from lare.errors import LareError
from lare.latent import design as module
from lare.latent.design import design
from lare.latent.function import verified
from lare.latent.reflect import EPISODES, gather, held_out_fit
from lare.latent.verify import random_steps
from lare.llm import prompts
from lare.llm.recording import RecordedModel, read_recording
from lare.tasks.play import episodes_of
from toys import Chase, toy_spec


def source(*factors: str) -> str:
    names = [f"f_{number}" for number in range(len(factors))]
    body = "".join(f"    {name} = {factor}\n" for name, factor in zip(names, factors, strict=True))
    return f"def evaluation_func(observation, action):\n{body}    return [{', '.join(names)}]"


RIGHT = source("np.square(action - observation[:, 0:1])", "action")
WRONG = source("observation[:, 1:2]")
CONSTANT = source("0 * action + 1", "observation[:, 1:2]", "2 * observation[:, 1:2]")


class Says:
    name = "says"

    def __init__(self, *sources: str):
        self.lines = [json.dumps({"Understand": "", "Analyze": "", "Functions": one}) for one in sources]
        self.asked = []

    def reply(self, messages, sample):
        self.asked.append(messages)
        return self.lines.pop(0)


@pytest.fixture(scope="module")
def episodes():
    return episodes_of(toy_spec(), EPISODES)


def test_episodes_are_whole_and_always_the_same(episodes):
    again = episodes_of(toy_spec(), EPISODES)
    assert len(episodes) == 40
    for one, other in zip(episodes, again, strict=True):
        assert (one.before.shape, one.action.shape, one.after.shape) == ((20, 1, 2), (20, 1, 1), (20, 1, 2))
        np.testing.assert_array_equal(one.before[1:], one.after[:-1])
        np.testing.assert_array_equal(one.after, other.after)
        # The toy pays -(a - s_0)^2.
        assert one.total == pytest.approx(-np.sum((one.action - one.before[..., :1]) ** 2), rel=1e-5)
        assert one.total == other.total


def test_episodes_of_a_policy():
    (perfect,) = episodes_of(toy_spec(), 1, lambda observation: observation[:1])
    assert perfect.total == pytest.approx(0, abs=1e-9)


def test_the_fit_is_of_unseen_episodes():
    random, alike = np.random.default_rng(0), np.ones(40)
    means = random.normal(size=(40, 3))
    assert held_out_fit(means, means @ [1.0, -2.0, 0.0] + 5, alike) > 0.99
    # Thirty useless factors would explain forty seen episodes well.
    assert held_out_fit(random.normal(size=(40, 30)), random.normal(size=40), alike) < 0.2
    assert held_out_fit(np.zeros((40, 1)), np.arange(40.0), alike) == pytest.approx(-0.04, abs=0.2)
    assert held_out_fit(means, np.zeros(40), alike) == pytest.approx(1)


@pytest.mark.parametrize("score", ["sum", "average"])
def test_the_fit_is_of_the_score_whether_it_is_a_sum_or_an_average(score):
    """Of episodes of 30 to 90 steps; a factor that knows only the length does not pass for one that knows the score."""
    random = np.random.default_rng(0)
    means, length = random.normal(size=(60, 2)), random.uniform(30, 90, size=60)
    mark = means @ [5.0, -3.0] + 60
    returns = mark if score == "average" else mark * length
    assert held_out_fit(means, returns, length) > 0.98
    assert score == "sum" or held_out_fit(1 / length[:, None], returns, length) < 0.2


def test_the_evidence_names_what_each_factor_did(episodes):
    task = toy_spec()
    right, wrong = (gather(verified(one, task), task, episodes) for one in (RIGHT, WRONG))
    assert right.fit > 0.99
    assert wrong.fit < 0.3
    lines = right.text.splitlines()
    assert lines[0].startswith("- f_0: from ")
    assert "correlates -1.00 with the return per step" in lines[0]
    assert "it correlates most" in lines[0]
    dead, one, two = gather(verified(CONSTANT, task), task, episodes).text.splitlines()
    assert "standard deviation 0;" in dead
    assert "+1.00 with f_2" in one
    assert "+1.00 with f_1" in two


def test_both_observations_are_named_apart(episodes):
    task = toy_spec(judges="both")
    text = gather(verified(WRONG, task), task, episodes).text
    assert [line.split(":")[0] for line in text.splitlines()] == ["- f_0, before the step", "- f_0, after the step"]


def test_a_better_function_is_kept_and_a_worse_one_is_not():
    task = toy_spec()
    said = []
    model = Says(WRONG, RIGHT, CONSTANT)
    function = design(task, model=model, candidates=1, reflect=2, said=said.append)
    assert function.source == RIGHT
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "reflect", "reflect"]
    assert said[-1].endswith("not better")
    # The second round is about the best function so far.
    assert "Functions" in model.asked[2][2]["content"]
    assert json.loads(model.asked[2][2]["content"])["Functions"] == RIGHT
    evidence = gather(verified(WRONG, task), task, episodes_of(task, EPISODES)).text
    assert model.asked[1] == prompts.reflect(
        task, json.dumps({"Understand": "", "Analyze": "", "Functions": WRONG}), evidence
    )


def test_what_was_recorded_answers_again(tmp_path):
    """Two rounds that ask for the same have two replies."""
    lines, path = (WRONG, CONSTANT, RIGHT), tmp_path / "talk.json"
    first = design(toy_spec(), model=Says(*lines), candidates=1, reflect=2, record=path)
    model = RecordedModel([read_recording(path.read_text(), "talk.json")], "Chase")
    again = design(toy_spec(), model=model, candidates=1, reflect=2)
    assert first.source == again.source == RIGHT


@pytest.mark.parametrize("error", [LareError("the environment has gone"), KeyboardInterrupt()])
def test_what_was_verified_is_kept_where_nothing_can_be_shown(monkeypatch, error):
    def gone(*_):
        raise error

    monkeypatch.setattr(module, "episodes_of", gone)
    said = []
    model = Says(RIGHT)
    assert design(toy_spec(), model=model, candidates=1, reflect=3, said=said.append).source == RIGHT
    assert said[-1] == f"no reflection: {str(error) or 'stopped'}"


def test_whoever_stops_a_reflection_takes_what_there_is():
    class Stops(Says):
        def reply(self, messages, sample):
            if not self.lines:
                raise KeyboardInterrupt
            return super().reply(messages, sample)

    said = []
    assert design(toy_spec(), model=Stops(RIGHT), candidates=1, reflect=3, said=said.append).source == RIGHT
    assert said[-1] == "reflection 1: stopped"


class Reused(Chase):
    """Writes every observation into the same memory."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        self.memory = np.array(observation)
        return self.memory, info

    def step(self, action):
        observation, *rest = super().step(action)
        self.memory[:] = observation
        return self.memory, *rest


gymnasium.register("misfits/Reused-v0", entry_point=Reused, max_episode_steps=20)


@pytest.mark.filterwarnings("ignore:.*share an object")  # Gymnasium sees it too
def test_observations_are_copied(episodes):
    task = toy_spec(environment="misfits/Reused-v0")
    for one, other in zip(episodes_of(task, EPISODES), episodes, strict=True):
        np.testing.assert_array_equal(one.before, other.before)
        np.testing.assert_array_equal(one.after, other.after)
    for one, other in zip(random_steps(task), random_steps(toy_spec()), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_round_that_fails_changes_nothing():
    model = Says(RIGHT, *["def f(): ..."] * 5)
    assert design(toy_spec(), model=model, candidates=1, reflect=1).source == RIGHT
    assert model.lines == []


def test_what_was_verified_is_kept_when_the_model_leaves():
    class Leaves(Says):
        def reply(self, messages, sample):
            if not self.lines:
                raise LareError("nobody there")
            return super().reply(messages, sample)

    said = []
    function = design(toy_spec(), model=Leaves(RIGHT), candidates=1, reflect=1, said=said.append)
    assert function.source == RIGHT
    assert said[-1] == "reflection 1: nobody there"


def test_episodes_of_a_given_policy():
    """The best there is returns 0, and its factor with it."""
    task = toy_spec()
    best = episodes_of(task, 2, lambda observation: observation[:1])
    assert [episode.total for episode in best] == pytest.approx([0, 0], abs=1e-9)
    model = Says(RIGHT, WRONG)
    design(task, model=model, candidates=1, reflect=1, policy=lambda observation: observation[:1] + 0.5)
    played = episodes_of(task, EPISODES, lambda observation: observation[:1] + 0.5)
    shown = gather(verified(RIGHT, task), task, played).text
    assert shown in model.asked[1][-1]["content"]
