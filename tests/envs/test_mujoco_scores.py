"""Scores that no text tells: what each pays, and that the task is else the usual one."""

import numpy as np
import pytest

import lare_rl
from lare_rl.envs.guarded_gymnasium import make
from lare_rl.envs.load import read_task
from lare_rl.envs.mujoco_scores import BODIES, FOOT, SCORES, SPEED, register

NAMES = [f"{body}{score}-v4" for body in BODIES for score in SCORES]


@pytest.mark.parametrize(
    ("score", "speed", "foot", "effort", "paid"),
    [
        ("Target", 2.0, 9.0, 0.5, 1 - 0.01),
        ("Target", 3.0, 9.0, 0.0, np.exp(-1)),
        ("Threshold", 2.0, 9.0, 0.5, -0.01),
        ("Threshold", 2.1, 9.0, 0.5, 1 - 0.01),
        ("Saturating", 1.0, 9.0, 2.0, np.tanh(1) - 0.1),
        ("Foot", 1.0, -0.3, 2.0, 1 - 0.2 - 0.3),
    ],
)
def test_scores_by_hand(score, speed, foot, effort, paid):
    after = np.zeros(17)
    after[[SPEED, FOOT]] = speed, foot
    assert SCORES[score](after, effort, 2.0) == pytest.approx(paid)


@pytest.mark.parametrize("name", NAMES)
def test_only_what_is_paid_differs_from_the_usual_task(name):
    body = next(body for body in BODIES if name.startswith(body))
    task, usual = read_task(name), read_task(f"{body}-v4")
    assert task.model_copy(update={"name": usual.name, "environment": usual.environment}) == usual
    ours, theirs = make(task.environment), make(usual.environment)
    starts = [environment.reset(seed=3)[0] for environment in (ours, theirs)]
    np.testing.assert_array_equal(*starts)
    for number in range(5):
        action = np.random.default_rng(number).uniform(-1, 1, ours.action_space.shape).astype(np.float32)
        (after, paid, *ends, _), (same, reward, *same_ends, _) = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(after, same)
        assert ends == same_ends
        want = SCORES[name.removeprefix(body).removesuffix("-v4")](after, float(np.sum(action**2)), BODIES[body])
        assert paid == pytest.approx(want)
        assert paid != pytest.approx(reward)
    ours.close()
    theirs.close()


def test_the_recorded_replies_are_those_of_the_usual_task():
    hidden, usual = (lare_rl.design(lare_rl.load_task(name)) for name in ("HalfCheetahTarget-v4", "HalfCheetah-v4"))
    assert hidden.source == usual.source


def test_registering_again_changes_nothing():
    register()
    register()
