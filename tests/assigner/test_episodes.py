"""Whole episodes, as logs have them: the same credit as step by step, and rewards of steps whose episode's length is known."""

import numpy as np
import pytest

from lare_rl import CreditAssigner, LareError


def episodes(count, random, longest=12):
    """Of two entries and one action; what they return is linear in the first entry."""
    for _ in range(count):
        steps = int(random.integers(1, longest))
        observation = random.normal(size=(steps + 1, 2)).astype(np.float32)
        action = random.normal(size=(steps, 1)).astype(np.float32)
        yield observation, action, 3 * observation[1:, 0].astype(float) + 1


def assigner(**others):
    return CreditAssigner("bayes", observation_space=2, action_space=1, capacity=10_000, **others)


def test_whole_episodes_give_the_credit_of_their_steps():
    whole, stepwise = assigner(), assigner()
    for observation, action, reward in episodes(150, np.random.default_rng(0)):
        numbers = whole.add_episode(observation[:-1], action, observation[1:], reward)
        steps = len(action)
        for t in range(steps):
            row = slice(t, t + 1)
            ended = [t == steps - 1]
            stepwise.add(observation[:-1][row], action[row], observation[1:][row], reward[row], ended, [False])
        assert len(numbers) == steps
    for credit in (whole, stepwise):
        credit.fit()
    every = np.arange(whole.store.steps)
    np.testing.assert_allclose(whole.rewards_at(every), stepwise.rewards_at(every), atol=1e-3)
    assert whole.metrics()["credit/episodes"] == stepwise.metrics()["credit/episodes"] == 150


def test_a_score_stands_for_its_rewards():
    by_score, by_rewards = assigner(), assigner()
    for observation, action, reward in episodes(60, np.random.default_rng(1)):
        by_score.add_episode(observation[:-1], action, observation[1:], reward.sum())
        by_rewards.add_episode(observation[:-1], action, observation[1:], reward)
    every = np.arange(by_score.store.steps)
    np.testing.assert_array_equal(by_score.rewards_at(every), by_rewards.rewards_at(every))


def test_observations_need_not_follow_each_other():
    """A log may say what steps set out from and what they led to, and round one of them."""
    credit = assigner()
    credit.add_episode(np.zeros((5, 2)), np.zeros((5, 1)), np.ones((5, 2)), 1.0)
    assert (credit.store.ended, credit.store.dropped) == (1, 0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"reward": np.nan}, "the score is nan: a number must be finite"),
        ({"reward": [0.0, np.inf]}, "reward of row 1 holds inf: a number must be finite"),
        ({"after": np.full((2, 2), np.nan)}, "after of row 0 holds nan: a number must be finite"),
        ({"reward": [1.0]}, "reward must be one number for each of 2 steps, and its shape is (1,)"),
    ],
)
def test_what_is_no_episode_is_refused(changed, message):
    given = {"before": np.zeros((2, 2)), "action": np.zeros((2, 1)), "after": np.zeros((2, 2)), "reward": 1.0} | changed
    credit = assigner()
    with pytest.raises(LareError) as error:
        credit.add_episode(**given)
    assert (str(error.value), credit.store.steps) == (message, 0)


def test_an_episode_longer_than_what_is_kept_is_refused():
    credit = CreditAssigner("bayes", observation_space=2, action_space=1, capacity=4)
    with pytest.raises(LareError, match=r"\A5 steps at once are more than the capacity of 4"):
        credit.add_episode(np.zeros((5, 2)), np.zeros((5, 1)), np.zeros((5, 2)), 1.0)


def test_steps_of_a_longer_episode_add_less_to_an_average():
    credit = assigner()
    for observation, action, reward in episodes(200, np.random.default_rng(2)):
        credit.add_episode(observation[:-1], action, observation[1:], reward.mean())
        credit.fit_owed()
    assert credit.form == "average"
    observation, action, reward = next(episodes(1, np.random.default_rng(3), longest=30))
    steps = observation[:-1], action, observation[1:]
    assert credit.rewards(*steps, length=np.full(len(action), len(action))).sum() == pytest.approx(
        reward.mean(), abs=0.1
    )
    once, twice = (credit.rewards(*steps, length=np.full(len(action), long)) for long in (10, 20))
    np.testing.assert_allclose(once, 2 * twice, rtol=1e-5)
    with pytest.raises(LareError, match="length must be one number for each of"):
        credit.rewards(*steps, length=3)


def test_what_is_not_to_be_forgotten_is_not():
    """A fifth of the episodes fit into the ring. Those of a log are all learned from; those of a loop make way for newer ones."""
    every, newest = (
        CreditAssigner("rd-linear", observation_space=2, action_space=1, capacity=500, forget=forget)
        for forget in (False, True)
    )
    for observation, action, reward in episodes(400, np.random.default_rng(4)):
        for credit in (every, newest):
            credit.add_episode(observation[:-1], action, observation[1:], reward)
            credit.fit_owed()
    for credit in (every, newest):
        credit.metrics()
    known = [float(np.sum(credit.learner.state.closed.summed.episodes)) for credit in (every, newest)]
    assert known[0] == 400
    assert known[1] < 300


def test_a_decoder_that_descends_a_gradient_learns_from_whole_episodes():
    credit = CreditAssigner("rrdu", observation_space=2, action_space=1, capacity=10_000, fits_per_step=0.0)
    for observation, action, reward in episodes(40, np.random.default_rng(5)):
        credit.add_episode(observation[:-1], action, observation[1:], reward)
    credit.fit(16)
    assert credit.metrics()["credit/fits"] == 16
    assert np.isfinite(credit.rewards_at([0])).all()
