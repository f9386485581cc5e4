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
from lare_rl.errors import LareError


class Scripted(gymnasium.Env):
    """Returns these rewards, and this info at the last step, which terminates or truncates the episode."""

    observation_space = action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, rewards, end="terminated", last_info=None):
        self.rewards, self.end, self.last_info = rewards, end, last_info or {}

    def reset(self, *, seed=None, options=None):
        self.remaining = list(self.rewards)
        return np.zeros(1, np.float32), {"fresh": True}

    def step(self, action):
        reward = self.remaining.pop(0)
        ended = not self.remaining
        terminated, truncated = ended and self.end == "terminated", ended and self.end == "truncated"
        info = {"step": 1} | (self.last_info if ended else {})
        return np.zeros(1, np.float32), reward, terminated, truncated, info


def play(env, steps):
    """Return the rewards and infos of some steps."""
    results = [env.step(np.zeros(1, np.float32)) for _ in range(steps)]
    return [result[1] for result in results], [result[4] for result in results]


def test_reset_starts_a_new_sum_and_a_score_replaces_it():
    env = EpisodicReward(Scripted([1.0, 2.0, 4.0]))
    assert env.reset()[1] == {"fresh": True}
    play(env, 2)
    for _ in range(2):
        env.reset()
        assert play(env, 3)[0] == [0.0, 0.0, 7.0]
    env = EpisodicReward(Scripted([1.0, 2.0, 4.0], last_info={"score": np.float32(9)}), score="score")
    env.reset()
    rewards, infos = play(env, 3)
    assert (rewards, [info[TRUE_REWARD] for info in infos]) == ([0.0, 0.0, 9.0], [1.0, 2.0, 4.0])


def test_reward_is_a_number_or_the_only_one_of_an_array():
    env = EpisodicReward(Scripted([np.array([2.0]), np.float32(1)]))
    env.reset()
    assert play(env, 2)[0] == [0.0, 3.0]
    env = EpisodicReward(Scripted([np.zeros(2)]))
    env.reset()
    with pytest.raises(LareError, match="the reward is array"):
        play(env, 1)


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50), st.sampled_from(["terminated", "truncated"]))
def test_reward_is_the_sum(rewards, end):
    env = EpisodicReward(Scripted(rewards, end))
    env.reset()
    episodic_rewards, infos = play(env, len(rewards))
    assert episodic_rewards[:-1] == [0.0] * (len(rewards) - 1)
    assert episodic_rewards[-1] == pytest.approx(math.fsum(rewards), abs=1e-9)
    assert infos == [{"step": 1, TRUE_REWARD: reward} for reward in rewards]


# The checker prefers an environment without its time limit, but only with it reaches the last step. Some of Gymnasium's
# own environments have no bounds, or bounds other than ±1. The checker makes v4 again, against Gymnasium's own advice.
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is (-)?infinity:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("name", ["CartPole-v1", "lare/HalfCheetahSparse-v4"])
def test_gymnasium_checker(name):
    env = EpisodicReward(make_gymnasium(name))
    check_env(env, skip_render_check=True)
    assert isinstance(gymnasium.make(env.spec), EpisodicReward)
    env.close()


@pytest.mark.parametrize(
    ("key", "value", "content"),
    [
        ("goals", 1, "no 'goals': it has 'step', 'score'"),
        ("score", "high", "'score'.* 'high', which is not a number"),
        ("score", math.nan, "'score'.* nan, which is not finite"),
        ("score", 10**400, "'score'.*, which is not a number"),
    ],
)
def test_invalid_score(key, value, content):
    env = EpisodicReward(Scripted([1.0], last_info={"score": value}), score=key)
    env.reset()
    with pytest.raises(LareError, match=content):
        play(env, 1)
