"""Reflection: what episodes say of a function, and that the better predictor of returns is kept."""

import json
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from helpers.toys import Chase, Says, toy_spec
from lare_rl.envs.play import Episode, episodes_of
from lare_rl.errors import LareError
from lare_rl.latent.design import design
from lare_rl.latent.function import verified
from lare_rl.latent.verify import random_steps
from lare_rl.llm import prompts
from lare_rl.llm.recording import RecordedModel, read_recording
from lare_rl.training import reflect as module
from lare_rl.training.reflect import EPISODES, evidence_of, reflect


def source(*factors: str) -> str:
    names = [f"f_{number}" for number in range(len(factors))]
    body = "".join(f"    {name} = {factor}\n" for name, factor in zip(names, factors, strict=True))
    return f"def evaluation_func(observation, action):\n{body}    return [{', '.join(names)}]"


RIGHT = source("np.square(action - observation[:, 0:1])", "action")
WRONG = source("observation[:, 1:2]")
CONSTANT = source("0 * action + 1", "observation[:, 1:2]", "2 * observation[:, 1:2]")


def designed(model, rounds, **given):
    """A first function, and the best one after some rounds."""
    record, said = given.get("record"), given.get("said", lambda _: None)
    function = design(toy_spec(), model=model, candidates=1, record=record, said=said)
    return reflect(function, toy_spec(), model, rounds, **given)


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


@pytest.mark.parametrize(("one", "least", "most"), [(RIGHT, 0.99, 1), (WRONG, -1, 0.3)])
def test_a_function_is_judged_by_returns_that_its_factors_have_not_seen(one, least, most, episodes):
    assert least < evidence_of(verified(one, toy_spec()), toy_spec(), episodes).r2 <= most


def test_the_evidence_says_what_each_factor_did_and_what_returns_say_of_it(episodes):
    task = toy_spec()
    lines = evidence_of(verified(RIGHT, task), task, episodes).text.splitlines()
    assert lines[0].startswith("- f_0: from ")
    assert "it correlates most" in lines[0]
    assert lines[2] == "The factors explain 100% of the variation of the returns of 40 episodes."
    assert lines[4].startswith("- f_0: 100%, -")
    assert lines[5].startswith("- f_1: 0%, ")
    dead, one, two, *_ = evidence_of(verified(CONSTANT, task), task, episodes).text.splitlines()
    assert "standard deviation 0;" in dead
    assert "+1.00 with f_2" in one
    assert "+1.00 with f_1" in two


def test_both_observations_are_named_apart(episodes):
    task = toy_spec(judges="both")
    text = evidence_of(verified(WRONG, task), task, episodes).text
    assert [line.split(":")[0] for line in text.splitlines()[:2]] == ["- f_0 (before)", "- f_0 (after)"]


def test_of_many_agents_those_that_have_left_do_not_count():
    task = toy_spec()
    random = np.random.default_rng(0)

    def episode(steps):
        alive = np.ones((steps, 3), bool)
        alive[steps // 2 :, 2] = False
        seen = random.normal(size=(steps, 3, 2)).astype(np.float32)
        action = random.uniform(-1, 1, (steps, 3, 1)).astype(np.float32)
        paid = -np.square(action - seen[..., :1])[..., 0]
        team = (paid * alive).sum(axis=1) / alive.sum(axis=1)
        seen[~alive] = 1e6
        return Episode(seen, action, seen, alive, paid, team)

    played = [episode(steps) for steps in random.integers(10, 30, size=40)]
    assert evidence_of(verified(RIGHT, task), task, played).r2 > 0.99


def test_where_all_returns_are_the_same_nothing_is_better(episodes):
    alike = [replace(one, team_reward=np.zeros(20)) for one in episodes]
    function, said = design(toy_spec(), model=Says(WRONG), candidates=1), []
    assert reflect(function, toy_spec(), Says(RIGHT), episodes=alike, said=said.append).source == WRONG
    assert said[-1] == "reflection 1: R² = nan, not better" or said[-1].endswith("not better")


def test_a_better_function_is_kept_and_a_worse_one_is_not():
    task = toy_spec()
    said = []
    model = Says(WRONG, RIGHT, CONSTANT)
    function = designed(model, 2, said=said.append)
    assert function.source == RIGHT
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "reflect", "reflect"]
    assert said[-1].endswith("not better")
    # The second round is about the best function so far.
    assert "Functions" in model.asked[2][2]["content"]
    assert json.loads(model.asked[2][2]["content"])["Functions"] == RIGHT
    evidence = evidence_of(verified(WRONG, task), task, episodes_of(task, EPISODES)).text
    assert model.asked[1] == prompts.reflect(
        task, json.dumps({"Understand": "", "Analyze": "", "Functions": WRONG}), evidence
    )


def test_what_was_recorded_answers_again(tmp_path):
    """Two rounds that ask for the same have two replies."""
    lines, path = (WRONG, CONSTANT, RIGHT), tmp_path / "talk.json"
    first = designed(Says(*lines), 2, record=path)
    model = RecordedModel([read_recording(path.read_text(), "talk.json")], "Chase")
    again = designed(model, 2)
    assert first.source == again.source == RIGHT


@pytest.mark.parametrize("error", [LareError("the environment has gone"), KeyboardInterrupt()])
def test_what_was_verified_is_kept_where_nothing_can_be_shown(monkeypatch, error):
    def gone(*_):
        raise error

    monkeypatch.setattr(module, "episodes_of", gone)
    said = []
    model = Says(RIGHT)
    assert designed(model, 3, said=said.append).source == RIGHT
    assert said[-1] == f"no reflection: {str(error) or 'stopped'}"


def test_whoever_stops_a_reflection_takes_what_there_is():
    class Stops(Says):
        def reply(self, messages, sample):
            if not self.lines:
                raise KeyboardInterrupt
            return super().reply(messages, sample)

    said = []
    assert designed(Stops(RIGHT), 3, said=said.append).source == RIGHT
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
    assert designed(model, 1).source == RIGHT
    assert model.lines == []


def test_what_was_verified_is_kept_when_the_model_leaves():
    said = []
    function = designed(Says(RIGHT), 1, said=said.append)
    assert function.source == RIGHT
    assert said[-1] == "reflection 1: nobody there"


def test_episodes_of_a_given_policy():
    """The best there is returns 0, and its factor with it."""
    task = toy_spec()
    best = episodes_of(task, 2, lambda observation: observation[:1])
    assert [episode.total for episode in best] == pytest.approx([0, 0], abs=1e-9)
    model = Says(RIGHT, WRONG)
    designed(model, 1, policy=lambda observation: observation[:1] + 0.5)
    played = episodes_of(task, EPISODES, lambda observation: observation[:1] + 0.5)
    shown = evidence_of(verified(RIGHT, task), task, played).text
    assert shown in model.asked[1][-1]["content"]
