"""Environments of Jumanji. `test_jax_families.py` compares them with its own steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import family_task, play, require_family, step_keys
from lare_rl.envs.interface import to_package_action
from lare_rl.envs.jax_packages import mask_combinations
from lare_rl.envs.jumanji_env import make

require_family("jumanji")


def test_time_limit_is_an_argument():
    maze = make(family_task("jumanji/Maze-v0", max_episode_steps=7))
    assert (maze.spec.max_steps, maze.env.time_limit) == (7, 7)


@pytest.mark.long
def test_several_choices_are_one():
    env = make(family_task("jumanji/Tetris-v0"))
    assert env.spec.action_size == 40
    first, actions, timesteps = play(env, 1, 2)
    state, timestep = env.env.reset(step_keys(1, 2)[0])
    np.testing.assert_array_equal(first.available[0, 0], timestep.observation.action_mask.ravel())
    action = to_package_action(actions[0, 0, 0], env.spec)
    np.testing.assert_array_equal(action, divmod(actions[0, 0, 0].argmax(), 10))
    _, timestep = env.env.step(state, action)
    np.testing.assert_array_equal(timesteps.observation[0, 0, 0, :100], timestep.observation.grid.ravel())
    assert timesteps.reward[0, 0, 0] == timestep.reward


def test_masks_of_each_choice():
    masks = jnp.array([[True, False, True], [True, True, False]])
    np.testing.assert_array_equal(mask_combinations(masks, (3, 2)), [True, True, False, False, True, True])
