"""The fully sparse half cheetah: 1 at the end of an episode that went far enough."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from lare_rl.envs.guarded_gymnasium import make
from lare_rl.envs.mujoco_sparse import SPARSE_HALF_CHEETAH, PaysForDistance, register


class Place(gymnasium.Env):
    """Takes one step, to where it is told."""

    observation_space = action_space = Box(-1, 1, (1,), np.float32)

    def __init__(self, x_position, terminated, truncated):
        self.result = np.zeros(1, np.float32), 99.0, terminated, truncated, {"x_position": x_position}

    def step(self, action):
        return self.result


@pytest.mark.parametrize(
    ("x_position", "terminated", "truncated", "paid"),
    [
        (500.1, False, True, 1.0),
        (500.1, True, False, 1.0),
        (500.1, True, True, 1.0),
        (500.1, False, False, 0.0),
        (500.0, False, True, 0.0),
        (-600.0, False, True, 0.0),
    ],
)
def test_pays_1_at_an_end_beyond_the_distance(x_position, terminated, truncated, paid):
    environment = Place(x_position, terminated, truncated)
    observation, _, *rest = environment.result
    assert PaysForDistance(environment).step(np.zeros(1)) == (observation, paid, *rest)


def test_the_sparse_half_cheetah_pays_nothing_until_the_end():
    environment = make(SPARSE_HALF_CHEETAH)
    assert environment.get_wrapper_attr("distance") == 500.0  # the paper's
    environment.reset(seed=0)
    results = [environment.step(np.zeros(6, np.float32)) for _ in range(1000)]
    environment.close()
    assert [reward for _, reward, *_ in results] == [0.0] * 1000
    assert [truncated for *_, truncated, _ in results] == [False] * 999 + [True]


def test_a_time_limit_of_ones_own_is_an_end_too():
    environment = make(SPARSE_HALF_CHEETAH, max_episode_steps=20)
    environment.reset(seed=0)
    environment.set_wrapper_attr("distance", -100.0)
    rewards = [environment.step(np.zeros(6, np.float32))[1] for _ in range(20)]
    environment.close()
    assert rewards == [0.0] * 19 + [1.0]


def test_registering_twice_changes_nothing():
    before = gymnasium.registry[SPARSE_HALF_CHEETAH]
    register()
    assert gymnasium.registry[SPARSE_HALF_CHEETAH] is before
