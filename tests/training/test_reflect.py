"""Reflection: what episodes tell about a function, and that the better predictor of returns is kept."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.scripted_model import ScriptedModel, to_reply
from helpers.toy_envs import toy_spec
from lare_rl.envs.play import Episode, play_episodes
from lare_rl.errors import LareError
from lare_rl.latent.design import design
from lare_rl.latent.function import verify_function
from lare_rl.llm import prompts
from lare_rl.llm.recording import RecordedModel, read_recording
from lare_rl.training.reflect import N_EPISODES, assess_function, reflect
from lare_rl.training.stored_episodes import stored_role_episodes

TASK = toy_spec()


def source(*factors: str) -> str:
    names = [f"f_{number}" for number in range(len(factors))]
    body = "".join(f"    {name} = {factor}\n" for name, factor in zip(names, factors, strict=True))
    return f"def evaluation_func(observation, action):\n{body}    return [{', '.join(names)}]"


RIGHT = source("np.square(action - observation[:, 0:1])", "action")
WRONG = source("observation[:, 1:2]")
CONSTANT = source("0 * action + 1", "observation[:, 1:2]", "2 * observation[:, 1:2]")


def design_and_reflect(model, rounds, record=None, messages=None, **arguments):
    on_message = (messages if messages is not None else []).append
    function = design(TASK, model=model, candidates=1, record=record, on_message=on_message)
    return reflect(function, TASK, model, rounds, record=record, on_message=on_message, **arguments)


def assess(function_source, episodes, task=TASK):
    return assess_function(verify_function(function_source, task), task, episodes)


@pytest.fixture(scope="module")
def episodes():
    return play_episodes(TASK, N_EPISODES)


@pytest.mark.long
def test_assessment_describes_factors(episodes):
    right = assess(RIGHT, episodes)
    assert right.ranges[0].startswith("- f_0: from ")
    assert "it correlates most" in right.ranges[0]
    assert "explain 100%" in right.sentences[0]
    assert right.sentences[2].startswith("- f_0: 100%, -")
    assert right.sentences[3].startswith("- f_1: 0%, ")
    dead, first, second = assess(CONSTANT, episodes).ranges
    assert "standard deviation 0;" in dead
    assert "+1.00 with f_2" in first
    assert "+1.00 with f_1" in second
    ranges = assess(WRONG, episodes, toy_spec(scored_observation="both")).ranges
    assert [line.split(":")[0] for line in ranges] == ["- f_0 (before)", "- f_0 (after)"]


@pytest.mark.long
def test_groups_have_intercepts(episodes):
    shift = [np.full(20, float(number % 2)) for number in range(N_EPISODES)]
    grouped = [
        replace(episode, team_reward=episode.team_reward + shift_t, group=f"level {shift_t[0]:g}")
        for episode, shift_t in zip(episodes, shift, strict=True)
    ]
    assessment = assess(RIGHT, grouped)
    assert assessment.fit.r2 > 0.98
    assert 0.5 < assessment.fit.level_r2 < assessment.fit.r2
    assert assess(RIGHT, episodes).fit.level_r2 is None


def test_number_of_groups_is_limited(episodes):
    grouped = [replace(episode, group=str(number)) for number, episode in enumerate(2 * episodes)]
    with pytest.raises(LareError, match="more than 64 groups"):
        assess(RIGHT, grouped)


def test_agents_that_left_do_not_count():
    rng = np.random.default_rng(0)

    def make_episode(length):
        alive = np.ones((length, 3), bool)
        alive[length // 2 :, 2] = False
        observation = rng.normal(size=(length, 3, 2)).astype(np.float32)
        action = rng.uniform(-1, 1, (length, 3, 1)).astype(np.float32)
        reward = -np.square(action - observation[..., :1])[..., 0]
        team_reward = (reward * alive).sum(axis=1) / alive.sum(axis=1)
        observation[~alive] = 1e6
        return Episode(observation, action, observation, alive, reward, team_reward)

    assert assess(RIGHT, [make_episode(length) for length in rng.integers(10, 30, size=40)]).fit.r2 > 0.99


def test_no_model_is_asked_without_a_reason(episodes):
    """If all returns are equal, or if there are too few episodes."""
    equal = [replace(episode, team_reward=np.zeros(20)) for episode in episodes]
    for played, text in ((equal, "equal"), (episodes[:3], "3 episodes say too little of a function: 20 are needed")):
        messages, model = [], ScriptedModel()
        function = reflect(verify_function(WRONG, TASK), TASK, model, episodes=played, on_message=messages.append)
        assert (function.source, len(messages), model.requests) == (WRONG, 1, [])
        assert text in messages[0]


def test_better_function_is_kept(episodes):
    messages, model = [], ScriptedModel(WRONG, RIGHT, CONSTANT)
    function = design_and_reflect(model, 2, messages=messages)
    assert function.source == RIGHT
    assert [exchange["stage"] for exchange in function.exchanges] == ["candidate", "reflect", "reflect"]
    assert messages[-1].endswith("not better")
    # The second round is about the best function so far.
    assert json.loads(model.requests[2][2]["content"])["Functions"] == RIGHT
    assessment = assess(WRONG, episodes)
    evidence = "\n".join([*assessment.ranges, *assessment.sentences])
    assert model.requests[1] == prompts.reflect(TASK, to_reply(WRONG), evidence)


@pytest.mark.long
def test_episodes_of_finished_run(learned_training):
    (run, _), model = learned_training, ScriptedModel(RIGHT)
    assert reflect(verify_function(WRONG, TASK), TASK, model, episodes=run).source == RIGHT
    assert assess(WRONG, stored_role_episodes(run, TASK), TASK).ranges[0] in model.requests[0][-1]["content"]


def test_recording_answers_again(tmp_path):
    """Two rounds with equal requests have two replies."""
    path = tmp_path / "talk.json"
    first = design_and_reflect(ScriptedModel(WRONG, CONSTANT, RIGHT), 2, record=path)
    again = design_and_reflect(RecordedModel([read_recording(path.read_text(), "talk.json")], "Chase"), 2)
    assert first.source == again.source == RIGHT


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (ScriptedModel(RIGHT), "reflection 1: no reply is left"),
        (ScriptedModel(RIGHT, error=KeyboardInterrupt()), "reflection 1: stopped"),
        (ScriptedModel(RIGHT, *["def f(): ..."] * 5), "reflection 1: "),
    ],
)
def test_failure_keeps_function(model, message):
    messages = []
    assert design_and_reflect(model, 1, messages=messages).source == RIGHT
    assert any(line.startswith(message) for line in messages)
    assert model.replies == []
