"""Remarks on large observations, and on a policy that does not change."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import lare_rl
from helpers.toys import Chase, Ear, toy_spec
from lare_rl.training import session as sessions
from lare_rl.training.advice import SATURATION, of_returns, of_saturation, saturation


class Bright(Chase):
    """The second entry of the observation is a light of up to 900 W/m²."""

    observation_space = Box(-1000, 1000, (2,), np.float32)

    def observe(self):
        return super().observe() * np.array([1, 900], np.float32)


gymnasium.register("toys/Bright-v0", entry_point=Bright, max_episode_steps=20)

BRIGHT = {"name": "Bright", "environment": "toys/Bright-v0", "observation": "0: the target\n1: light (W/m²)"}


def heard(task, settings, out):
    ear = Ear()
    lare_rl.train(task, settings, out=out, listeners=[ear])
    return [line for line in ear.heard if line.startswith("Observations are large")]


def test_large_observations_are_reported_once(small, tmp_path):
    settings = small(method="dense", algorithm="td3", seeds=2, steps=204)
    (line,) = heard(toy_spec(**BRIGHT), settings, tmp_path / "bright")
    head, tail = line.split(" in the first steps, ")
    assert head.startswith(
        "Observations are large: the root mean square of entry 1 of the observation (light (W/m²)) is 5"
    )
    assert tail == (
        "and td3 does not normalise observations. Its actions may stay at their bounds. Let the environment divide each entry by "
        "its range, so that it is within about -1 and 1, or use --algorithm ppo, which normalises observations."
    )


def test_small_observations_and_normalised_ones_are_not(small, tmp_path):
    assert not heard(toy_spec(), small(method="dense", algorithm="td3", seeds=1, steps=96), tmp_path / "small")
    assert not heard(
        toy_spec(**BRIGHT), small(method="dense", algorithm="ppo", seeds=1, steps=96), tmp_path / "normalised"
    )


@pytest.mark.parametrize(
    ("returns", "said"),
    [
        ([[7.5, 8.0]] * 4, False),
        ([[7.5, 8.0]] * 5, True),
        ([[7.5, 8.0]] * 6, False),  # it was said before
        ([[7.5, 8.0]] * 6 + [[9.0, 8.0]] + [[7.5, 8.0]] * 5, True),
        ([[7.5, float(step)] for step in range(5)], False),
        ([[0.0]] * 5, True),
        ([[-7.5], [-7.5001], [-7.5], [-7.5], [-7.5]], True),
    ],
)
def test_a_policy_that_does_not_change(returns, said):
    assert bool(of_returns([np.array(each) for each in returns])) == said


STUCK = np.full((1, 4, 2), [[1.0, -0.995]])


@pytest.mark.parametrize(
    ("actions", "shares", "whose"),
    [
        (STUCK, [1.0], "The policy chooses"),
        (np.concatenate([STUCK * 0.5, STUCK]), [0.0, 1.0], "The policy of seed 4 chooses"),
        (np.concatenate([STUCK, -STUCK, STUCK * 0.5]), [1.0, 1.0, 0.0], "The policy of seeds 3, 4 chooses"),
        (STUCK * [1.0, 0.9], [0.5], None),  # one entry is not at a bound
        (STUCK * [[1.0], [1.0], [-1.0], [1.0]], [0.0], None),  # from one bound to the other
    ],
)
def test_a_policy_at_its_bounds(actions, shares, whose):
    assert list(saturation(actions)) == shares
    said = of_saturation(shares, range(3, 3 + len(actions)))
    assert [line.partition(" the same action")[0] for line in said] == ([] if whose is None else [whose])


def test_the_newest_states_are_asked(small, tmp_path):
    run = lare_rl.train(toy_spec(), small(method="dense", algorithm="td3", seeds=2), out=tmp_path / "run", listeners=[])
    session, _ = sessions.restore(run)
    actions = session.actions_now(5)
    assert actions.shape == (2, 5, 1)
    held = session.learner.replay
    newest = int(held.next_row[1, 0]) - np.arange(1, 6)
    seen = np.asarray(held.columns["observation"][1, 0, newest, 0])
    np.testing.assert_allclose(2 * actions[1], lare_rl.policy_of(run, seed=run.seeds[1])(seen), rtol=1e-5)
    assert session.actions_now(5000).shape == (2, 5000, 1)  # more than are stored: they are repeated
    session.close()


def test_a_policy_that_has_not_been_trained_says_nothing(small, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions.Session, "actions_now", lambda session, steps: np.ones((1, steps, 1)))
    for steps, count in ((24, 0), (48, 1)):
        ear, settings = Ear(), small(method="dense", algorithm="td3", seeds=1, steps=steps, td3={"warmup": 24})
        run = lare_rl.train(toy_spec(), settings, out=tmp_path / str(steps), listeners=[ear])
        assert sum(line.startswith("The policy chooses") for line in ear.heard) == count
        assert [line.get(SATURATION) for line in run.metrics()] == [1.0 if count else None]
