"""The episodic setting: nothing until the end, then the sum."""

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.envs.episodic import TRUE_REWARD, EpisodicReward
from lare_rl.envs.gymnasium_env import make_gymnasium
from lare_rl.envs.load import read_task, shipped_tasks
from lare_rl.errors import LareError


class Scripted(gymnasium.Env):
    """Pays the given rewards, one a step, and ends with the last: terminated or truncated."""

    observation_space = action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, rewards, end="terminated"):
        self.rewards, self.end = rewards, end

    def reset(self, *, seed=None, options=None):
        self.left = list(self.rewards)
        return np.zeros(1, np.float32), {"fresh": True}

    def step(self, action):
        reward = self.left.pop(0)
        over = not self.left
        terminated, truncated = over and self.end == "terminated", over and self.end == "truncated"
        return np.zeros(1, np.float32), reward, terminated, truncated, {"mine": 1}


def play(environment, steps):
    """What each step paid, and the info that came with it."""
    results = [environment.step(np.zeros(1, np.float32)) for _ in range(steps)]
    return [result[1] for result in results], [result[4] for result in results]


@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_pays_the_sum_at_the_end_and_nothing_before(end):
    environment = EpisodicReward(Scripted([1, -2.5, 4], end))
    assert environment.reset()[1] == {"fresh": True}
    paid_rewards, infos = play(environment, 3)
    assert paid_rewards == [0.0, 0.0, 2.5]
    assert infos == [{"mine": 1, TRUE_REWARD: reward} for reward in (1.0, -2.5, 4.0)]


def test_a_reset_in_mid_episode_starts_anew():
    environment = EpisodicReward(Scripted([1.0, 2.0, 4.0]))
    environment.reset()
    play(environment, 2)
    environment.reset()
    assert play(environment, 3)[0] == [0.0, 0.0, 7.0]


def test_episodes_do_not_add_up():
    environment = EpisodicReward(Scripted([1.0, 2.0]))
    for _ in range(3):
        environment.reset()
        assert play(environment, 2)[0] == [0.0, 3.0]


@settings(deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50), st.sampled_from(["terminated", "truncated"]))
def test_whatever_the_rewards_the_payment_is_their_sum(rewards, end):
    environment = EpisodicReward(Scripted(rewards, end))
    environment.reset()
    paid_rewards, infos = play(environment, len(rewards))
    assert paid_rewards[:-1] == [0.0] * (len(rewards) - 1)
    assert paid_rewards[-1] == pytest.approx(math.fsum(rewards), abs=1e-9)
    assert [info[TRUE_REWARD] for info in infos] == rewards


# The checker would rather see an environment without its time limit; with it, it can walk to the payment.
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
# Gymnasium's own environments observe without bounds, on purpose.
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is (-)?infinity:UserWarning")
# Pendulum's torques are not within -1 and 1: Gymnasium would like that better.
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
# The checker makes the environment again, by Gymnasium itself, which advises against v4.
@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize(
    "name",
    [
        "CartPole-v1",
        "Pendulum-v1",
        *sorted({task.environment for task in map(read_task, shipped_tasks()) if task.family in ("", "lare")}),
    ],
)
def test_gymnasiums_checker_finds_no_fault(name):
    environment = EpisodicReward(make_gymnasium(name))
    check_env(environment, skip_render_check=True)
    environment.close()


def test_it_can_be_made_again_from_its_spec():
    environment = EpisodicReward(make_gymnasium("Pendulum-v1"))
    again = gymnasium.make(environment.spec)
    assert isinstance(again, EpisodicReward)


class Scored(Scripted):
    """Its last info has a score."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, info | ({"score": self.score} if not self.left else {})


def test_a_score_may_be_paid_instead():
    environment = EpisodicReward(Scored([1.0, 2.0, 4.0]), score="score")
    environment.unwrapped.score = np.float32(9)
    environment.reset()
    paid_rewards, infos = play(environment, 3)
    assert paid_rewards == [0.0, 0.0, 9.0]
    assert [info[TRUE_REWARD] for info in infos] == [1.0, 2.0, 4.0]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("goals", 1, "the info of the last step has no 'goals': it has 'mine', 'score'"),
        ("score", "high", "info['score'] of the last step is 'high', which is not a number"),
        ("score", math.nan, "info['score'] of the last step is nan, which is not finite"),
    ],
)
def test_a_score_that_is_none_is_refused(key, value, message):
    environment = EpisodicReward(Scored([1.0, 2.0]), score=key)
    environment.unwrapped.score = value
    environment.reset()
    play(environment, 1)
    with pytest.raises(LareError) as refused:
        play(environment, 1)
    assert str(refused.value) == message
