"""Verification: what is refused, with which message, and the steps that a function is tried on."""

import numpy as np
import pytest

from helpers.tiers import long
from helpers.toys import PHI, phi, toy_spec
from lare_rl.envs.load import read_task
from lare_rl.errors import LareError
from lare_rl.latent import verify as module
from lare_rl.latent.verify import Check, random_steps, sample_steps, verify
from lare_rl.llm.recording import SHIPPED, read_recording
from lare_rl.llm.reply import parse

RECORDINGS = {
    f"{kind.name}/{entry.name}": read_recording(entry.read_text(encoding="utf-8"), entry.name)
    for kind in sorted(SHIPPED.iterdir(), key=lambda folder: folder.name)
    for entry in sorted(kind.iterdir(), key=lambda file: file.name)
}
RECORDED = [name if name.startswith("reward/") and "draw0" in name else long(name) for name in RECORDINGS]
"""`test_design.py` verifies the first draw of every task's factors."""


@pytest.mark.parametrize(
    ("source", "errors"),
    [
        (phi("raise ValueError(np.load('x'))"), ["E-NUMPY line 2: np.load"]),
        (
            "import os\n" + phi("return [action, np.two(3)]"),
            ["E-IMPORT line 1: import os", "E-NUMPY line 3: np.two"],
        ),
        ("(" * 41, ["E-SYNTAX line 1: "]),
        ("X = [1][1:][0]\n" + phi("return [action]"), ["E-RUN line 1: IndexError: list index out of range"]),
        (phi("return [no_idea]"), ["E-RUN line 2: no_idea is not defined"]),
        (phi("while True: pass\nreturn [action]"), ["E-COST line 2: "]),
        (phi("return [action[:, 0]]"), ["E-FORM line 2: factor 1 must be an array of the shape (batch, 1)"]),
        (phi("return [action - action.mean()]"), ["E-ROWS line 2: "]),
        (phi("x = action * np.sign(action[0])\nreturn [x]"), ["E-ROWS line 2: "]),
        (phi("for row in action: pass\nreturn [action]"), ["E-ROWS line 2: "]),
        ("x = 1", ["E-FORM line 1: there is no function evaluation_func"]),
    ],
)
def test_verify_unreadable(chase, source, errors):
    verdict = verify(source, chase)
    assert not verdict.passed
    assert [check.name for check in verdict.checks] == ["read"]
    messages = verdict.errors.splitlines()
    assert len(messages) == len(errors)
    for message, start in zip(messages, errors, strict=True):
        assert message.startswith(start)
    assert (verdict.graph, verdict.advice) == (None, ())


def test_verify_sound_function(chase):
    verdict = verify(PHI, chase)
    assert verdict.passed
    assert verdict.errors == ""
    assert verdict.checks == (Check("read", True), Check("finite", True))
    assert (verdict.graph.factor_count, verdict.advice) == (2, ())


@pytest.mark.parametrize("returned", ["[action, action]", "[]"])
def test_verify_reward_is_one_array(chase, returned):
    verdict = verify(phi(f"return {returned}"), chase, "reward")
    assert verdict.errors.startswith("E-FORM line 2: evaluation_func must return exactly one reward array")
    assert verify(phi("return [action]"), chase, "reward").passed


@pytest.mark.parametrize("count", [0, 33])
def test_verify_number_of_factors(chase, count):
    assert verify(phi("return [action] * 32"), chase).passed
    assert verify(phi(f"return [action] * {count}"), chase).errors.startswith("E-FORM line 2: evaluation_func must re")


@pytest.mark.parametrize(
    ("factor", "value", "operation", "batch"),
    [
        ("np.log(action)", "nan", "log", "recorded steps"),
        ("1 / (action - action)", "inf", "divide", "recorded steps"),
        ("-np.exp(400 * np.abs(action))", "-inf", "exp", "recorded steps"),
        ("np.sqrt(2.5 - np.abs(action))", "nan", "sqrt", "random steps"),
        ("action / np.sum(np.abs(observation), axis=1, keepdims=True)", "nan", "divide", "nothing but zeros"),
        ("1 / (np.prod(observation, axis=1, keepdims=True) - 1)", "inf", "divide", "nothing but ones"),
        (
            "1 / (observation[:, 0:1] + 2 * np.sum(observation, axis=1, keepdims=True) - 3)",
            "inf",
            "divide",
            "single one",
        ),
        ("np.sqrt(1000 - 10 * np.abs(observation[:, 0:1]))", "nan", "sqrt", "times 1000"),
        ("np.where(observation == 0, 0, 1 / observation**5)[:, 0:1]", "inf", "divide", "times 1e-9"),
    ],
)
def test_verify_not_finite(chase, factor, value, operation, batch):
    verdict = verify(phi(f"near = {factor}\nreturn [action, near]"), chase)
    assert [check.passed for check in verdict.checks] == [True, False]
    assert verdict.errors.startswith(f"E-FINITE line 2: factor 2, 'near', is {value} ({operation}) for ")
    assert batch in verdict.errors
    assert verdict.graph is not None
    assert verdict.advice == ()


def test_verify_advice_is_no_error(chase):
    body = (
        "still = 0 * action\nones = np.ones((len(action), 1))\nagain = -2 * action\nreturn [action, still, ones, again]"
    )
    verdict = verify(phi(body), chase)
    assert verdict.passed
    assert [(advice.split()[1], advice.split()[2]) for advice in verdict.advice] == [
        ("'still'", "never"),
        ("'ones'", "reads"),
        ("'again'", "repeats"),
    ]


def test_verify_no_advice_for_factors_that_are_nearly_the_same(chase):
    body = "curved = np.sign(action) * np.abs(action)**1.5\nfaint = 1 + 1e-3 * observation\nreturn [action, curved, faint[:, 0:1]]"
    assert verify(phi(body), chase).advice == ()


@pytest.mark.parametrize("name", RECORDED)
def test_verify_recorded_combination(name):
    recording = RECORDINGS[name]
    source = parse(recording.exchanges[-1].replies[0]).functions
    verdict = verify(source, read_task(recording.task), recording.kind)
    assert verdict.errors == ""
    assert verdict.passed


# --- steps to try a function on --------------------------------------------------------------------------------------


def test_random_steps_are_the_tasks_and_always_the_same(chase):
    observation, action = random_steps(chase, 50)
    assert (observation.shape, action.shape) == ((50, 2), (50, 1))
    assert (observation.dtype, action.dtype) == (np.float32, np.float32)
    assert np.abs(observation).max() <= 1
    assert 1 < np.abs(action).max() <= 2
    # Episodes of 20 steps: there was a reset in between, and every step is a new one.
    assert len(np.unique(observation[:, 0])) == 50
    module._random_steps.cache_clear()
    for array, again in zip((observation, action), random_steps(chase, 50), strict=True):
        np.testing.assert_array_equal(array, again)
    assert not np.array_equal(action, random_steps(chase, 50, seed=1)[1])


def test_random_steps_are_read_only(chase):
    for array in random_steps(chase, 50):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_random_steps_of_another_task(chase):
    longer = toy_spec(max_episode_steps=50)
    assert not np.array_equal(random_steps(chase, 50)[0], random_steps(longer, 50)[0])


PARALLEL = {
    "name": "toy",
    "environment": "pettingzoo/helpers.parallel_toys:Toy",
    "observation_size": 2,
    "action_size": 3,
}
"""An observation says how much of an episode of five steps is over."""


def test_random_steps_without_agents_that_have_left():
    """Of two agents one acts twice in an episode, the other at each step."""
    observation, action = random_steps(toy_spec(**PARALLEL, arguments={"leaves": {"a_1": 2}}), 70)
    assert np.bincount(observation[:, 1].astype(int)).tolist() == [20, 20, 10, 10, 10]
    np.testing.assert_array_equal(action.sum(axis=1), 1)


@pytest.mark.parametrize(
    ("judges", "times"),
    [("before", [14, 14, 14, 14, 14]), ("after", [0, 14, 14, 14, 14, 14]), ("both", [7, 14, 14, 14, 14, 7])],
)
def test_random_steps_judged_as_the_task_says(judges, times):
    observation, _ = random_steps(toy_spec(**PARALLEL, judges=judges), 70)
    assert np.bincount(observation[:, 1].astype(int)).tolist() == times


def test_random_steps_reach_the_end():
    """A step before the last is left out rather than the end."""
    longer = toy_spec(max_episode_steps=1000)
    every, few = random_steps(longer, 1000), random_steps(longer, 50)
    for whole, chosen in zip(every, few, strict=True):
        np.testing.assert_array_equal(chosen[[0, -1]], whole[[0, -1]])


def test_random_steps_of_an_agent_that_never_acts():
    team = toy_spec(**PARALLEL, arguments={"joins": {"a_1": 9}}, agents=("a_1",), team="late")
    with pytest.raises(LareError, match=r"^no agent of toy acted in 5120 steps of random actions$"):
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
    ("observation", "action", "message"),
    [
        (np.zeros((5, 3)), np.zeros((5, 1)), r"^observations of steps must have the shape \(n, 2\)"),
        (np.zeros((5, 2)), np.zeros((5, 2)), r"^actions of steps must have the shape \(n, 1\)"),
        (np.zeros((0, 2)), np.zeros((0, 1)), r"^observations of steps must have the shape \(n, 2\)"),
        (np.full((5, 2), np.nan), np.zeros((5, 1)), "^observations of steps hold a number that is not finite$"),
    ],
)
def test_sample_steps_of_other_sizes(chase, observation, action, message):
    with pytest.raises(LareError, match=message):
        sample_steps(chase, (observation, action))
