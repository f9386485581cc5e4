"""Verification of sources, and the steps that they are tried on."""

import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.toy_envs import phi_source, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent import verify as verify_module
from lare_rl.latent.verify import random_steps, sample_steps, verify
from lare_rl.llm.recording import SHIPPED_RECORDINGS, read_recording
from lare_rl.llm.reply import parse_reply

KINDS = SHIPPED_RECORDINGS / "factors", SHIPPED_RECORDINGS / "reward"
RECORDINGS = sorted(f"{kind.name}/{entry.name}" for kind in KINDS for entry in kind.iterdir())
SHORT = ("reward/HalfCheetah-v4.draw0.json", "reward/Reacher-v4.draw0.json", "factors/Reacher-v4.draw2.json")


def test_verify_unreadable(chase):
    verdict = verify("import os\n" + phi_source("return [np.two(3)]"), chase)
    assert not verdict.passed
    assert [check.name for check in verdict.checks] == ["read"]
    first, second = verdict.errors.splitlines()
    assert first.startswith("E-IMPORT line 1: import os")
    assert second.startswith("E-NUMPY line 3: np.two")
    assert (verdict.graph, verdict.advice) == (None, ())


@pytest.mark.parametrize("returned", ["[action, action]", "[]"])
def test_verify_reward_is_one_array(chase, returned):
    verdict = verify(phi_source(f"return {returned}"), chase, "reward")
    assert verdict.errors.startswith("E-FORM line 2: evaluation_func must return exactly one reward array")
    assert verify(phi_source("return [action]"), chase, "reward").passed
    assert verify(phi_source("return [action] * 32"), chase).passed


@pytest.mark.parametrize(
    ("factor", "value", "operation", "batch"),
    [
        ("np.log(action)", "nan", "log", "steps of the task"),
        ("1 / (action - action)", "inf", "divide", "steps of the task"),
        ("-np.exp(400 * np.abs(action))", "-inf", "exp", "steps of the task"),
        ("np.sqrt(2.5 - np.abs(action))", "nan", "sqrt", "steps of random numbers"),
        ("action / np.sum(np.abs(observation), axis=1, keepdims=True)", "nan", "divide", "nothing but zeros"),
        ("1 / (np.prod(observation, axis=1, keepdims=True) - 1)", "inf", "divide", "nothing but ones"),
        ("1 / (3 * observation[:, :1] + 2 * observation[:, 1:] - 3)", "inf", "divide", "single one"),
        ("np.sqrt(1000 - 10 * np.abs(observation[:, 0:1]))", "nan", "sqrt", "times 1000"),
        ("np.where(observation == 0, 0, 1 / observation**5)[:, 0:1]", "inf", "divide", "times 1e-9"),
    ],
)
def test_verify_not_finite(chase, factor, value, operation, batch):
    verdict = verify(phi_source(f"near = {factor}\nreturn [action, near]"), chase)
    assert [check.passed for check in verdict.checks] == [True, False]
    assert verdict.errors.startswith(f"E-FINITE line 2: factor 2, 'near', is {value} ({operation}) for ")
    assert batch in verdict.errors
    assert verdict.graph is not None
    assert verdict.advice == ()


def test_verify_advice_is_no_error(chase):
    body = (
        "unit = np.sin(action)**2 + np.cos(action)**2\nones = np.ones((len(action), 1))\nagain = -2e25 * action\n"
        "return [action, unit, ones, again, 1e-12 * observation[:, :1]]"
    )
    verdict = verify(phi_source(body), chase)
    assert verdict.passed
    remarks = [tuple(advice.split()[1:3]) for advice in verdict.advice]
    assert remarks == [("'unit'", "never"), ("'ones'", "reads"), ("'again'", "repeats")]
    # None for factors that are nearly the same.
    body = "curved = np.sign(action) * np.abs(action)**1.5\nfaint = 1 + 1e-3 * observation\nreturn [action, curved, faint[:, 0:1]]"
    assert verify(phi_source(body), chase).advice == ()


@pytest.mark.parametrize("name", [name if name in SHORT else long_case(name) for name in RECORDINGS])
def test_verify_recorded_combination(name):
    recording = read_recording((SHIPPED_RECORDINGS / name).read_text(encoding="utf-8"), name)
    source = parse_reply(recording.exchanges[-1].replies[0]).functions
    verdict = verify(source, read_task(recording.task), recording.kind)
    assert verdict.errors == ""
    assert verdict.passed


def test_random_steps(chase):
    observation, action = random_steps(chase, 50)
    assert (observation.shape, action.shape) == ((50, 2), (50, 1))
    assert (observation.dtype, action.dtype) == (np.float32, np.float32)
    assert np.abs(observation).max() <= 1
    assert 1 < np.abs(action).max() <= 2
    # Episodes have 20 steps, so these are of several episodes.
    assert len(np.unique(observation[:, 0])) == 50
    for array, equal in zip((observation, action), random_steps(toy_spec(description="The same."), 50), strict=True):
        np.testing.assert_array_equal(array, equal)
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert not np.array_equal(action, random_steps(toy_spec(max_episode_steps=50), 50)[1])


PARALLEL = {"environment": "pettingzoo/helpers.parallel_toy_envs:Toy", "observation_size": 2, "action_size": 3}
"""The second entry of an observation is the step within an episode of five steps."""


def test_random_steps_of_many_agents(monkeypatch):
    """Observations before or after a step. Agents that have left do not count: one acts at each step, the other at two of five."""
    for changes, counts in (
        ({"scored_observation": "before"}, [14, 14, 14, 14, 14]),
        ({"scored_observation": "after"}, [0, 14, 14, 14, 14, 14]),
        ({"scored_observation": "both"}, [7, 14, 14, 14, 14, 7]),
        ({"arguments": {"leaves": {"a_1": 2}}}, [20, 20, 10, 10, 10]),
    ):
        observation, action = random_steps(toy_spec(**PARALLEL, **changes), 70)
        assert np.bincount(observation[:, 1].astype(int)).tolist() == counts
        np.testing.assert_array_equal(action.sum(axis=1), 1)
    monkeypatch.setattr(verify_module, "_MAX_PLAYED_STEPS", 50)
    team = toy_spec(**PARALLEL, arguments={"joins": {"a_1": 9}}, agents=("a_1",), team="late")  # it never acts
    with pytest.raises(LareError, match="no agent of Chase"):
        random_steps(team, 10)


def test_sample_steps_evenly_spaced(chase):
    steps = np.arange(2000.0).reshape(1000, 2), np.arange(1000.0).reshape(1000, 1)
    observation, action = sample_steps(chase, steps)
    assert (observation.shape, action.shape) == ((256, 2), (256, 1))
    assert (observation.dtype, action.dtype) == (np.float32, np.float32)
    np.testing.assert_array_equal(observation[:, 0], 2 * action[:, 0])
    assert action[[0, -1], 0].tolist() == [0, 999]
    np.testing.assert_array_equal(sample_steps(chase, (steps[0][:3], steps[1][:3]))[1], [[0], [1], [2]])
    assert sample_steps(chase, None)[0] is random_steps(chase)[0]


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ((np.full((5, 2), np.nan), np.zeros((5, 1))), "observations .*not finite"),
        ((np.full((5, 2), 1e39), np.zeros((5, 1))), "observations .*not finite"),  # in float32
        ((np.zeros((5, 2)), np.full((5, 1), np.inf)), "actions .*not finite"),
    ],
)
def test_invalid_sample_steps(chase, steps, words):
    with pytest.raises(LareError, match=words):
        sample_steps(chase, steps)
