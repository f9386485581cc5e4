"""Environments of Jumanji, compared with its own steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from lare_rl.envs.interface import to_package_action
from lare_rl.envs.jax_packages import mask_combinations
from lare_rl.envs.jumanji_env import make

require_family("jumanji")

KNAPSACK = "jumanji/Knapsack-v1"


def test_last_observation_is_the_terminal_state():
    env = make(family_task(KNAPSACK, max_episode_steps=50))
    assert env.spec.masks_actions
    first, actions, timesteps = play(env, 2, 40)
    check_arrays(env.spec, timesteps)
    last = int(timesteps.terminated[0].argmax())
    assert timesteps.terminated[0, last]
    assert not timesteps.truncated[0, : last + 1].any()
    weights, values, packed = np.split(timesteps.observation[0, last, 0], 3)
    assert ((packed == 1) | (weights > 12.5 - weights @ packed - 1e-5)).all()  # no other item fits
    assert timesteps.reward[0, : last + 1].sum() == pytest.approx(values @ packed, rel=1e-5)

    state, timestep = env.env.reset(step_keys(2, 40)[0])
    np.testing.assert_array_equal(first.available[0, 0], timestep.observation.action_mask)
    for number in range(last + 1):
        state, timestep = env.env.step(state, jnp.int32(actions[0, number, 0].argmax()))
        observation = timestep.observation
        arrays = observation.weights, observation.values, observation.packed_items
        np.testing.assert_array_equal(timesteps.observation[0, number, 0], np.concatenate(arrays))
        assert timesteps.terminated[0, number] == (timestep.last() and timestep.discount == 0)
        if number < last:
            np.testing.assert_array_equal(timesteps.available[0, number, 0], observation.action_mask)
    assert timesteps.available[0, last, 0, 0]  # Jumanji's mask has no action any more


def test_time_limits():
    maze = make(family_task("jumanji/Maze-v0", max_episode_steps=7))
    assert (maze.spec.max_steps, maze.env.time_limit) == (7, 7)
    cut = make(family_task("jumanji/Game2048-v1", max_episode_steps=3, measures=["highest_tile"]))
    _, _, timesteps = play(cut, 2, 3)
    np.testing.assert_array_equal(timesteps.truncated, [[False, False, True]] * 2)
    assert not timesteps.terminated.any()
    assert (timesteps.measures["highest_tile"] >= 2).all()


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
