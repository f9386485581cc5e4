"""Choices as rows of numbers."""

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete

from lare_rl.envs.guarded_gymnasium import make
from lare_rl.envs.spaces import OneHot, OneHotAction


class Three(gymnasium.Env):
    """Remembers what was chosen; its actions are 5, 6 and 7."""

    observation_space = Discrete(4)
    action_space = Discrete(3, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        self.chosen = action
        return int(action) - 4, 0.0, False, False, {}


gymnasium.register("toys/Three-v0", entry_point=Three, max_episode_steps=10)


def test_an_environment_of_choices_takes_rows_and_gives_rows():
    environment = make("toys/Three-v0")
    assert isinstance(environment.action_space, OneHot)
    observation, _ = environment.reset(seed=0)
    np.testing.assert_array_equal(observation, [1, 0, 0, 0])
    observation, *_ = environment.step(np.array([0.2, 0.1, 0.9], np.float32))
    assert environment.unwrapped.chosen == 7
    np.testing.assert_array_equal(observation, [0, 0, 0, 1])


def test_a_sample_has_a_single_one_and_every_choice_comes():
    space = OneHot(3, seed=0)
    rows = np.stack([space.sample() for _ in range(100)])
    assert set(map(tuple, rows)) == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}
    assert all(space.contains(row) for row in rows)


def test_an_algorithms_output_becomes_the_choice_of_its_largest_number():
    np.testing.assert_array_equal(OneHot(3).chosen(np.array([-1, 0.5, 0.4], np.float32)), [0, 1, 0])


def test_the_number_of_a_choice_counts_from_the_environments_first():
    assert OneHot(3, start=5).number(np.array([0.2, 0.1, 0.9], np.float32)) == 7


def test_what_is_a_row_already_stays_as_it_is():
    assert not isinstance(make("Pendulum-v1").unwrapped, OneHotAction)
    assert make("Pendulum-v1").observation_space.shape == (3,)
