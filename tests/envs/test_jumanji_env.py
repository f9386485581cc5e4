"""Environments of Jumanji, compared with its own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, skip_without, step_keys
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import to_package_action
from lare_rl.envs.jax_spaces import Choices
from lare_rl.envs.jumanji_env import make
from lare_rl.errors import LareError
from lare_rl.new_task.single_agent import draft_task

skip_without("jumanji")

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
    assert make(family_task("jumanji/Maze-v0")).spec.max_steps == 100
    maze = make(family_task("jumanji/Maze-v0", max_episode_steps=7))
    assert (maze.spec.max_steps, maze.env.time_limit) == (7, 7)
    cut = make(family_task("jumanji/Game2048-v1", max_episode_steps=3, measures=["highest_tile"]))
    _, _, timesteps = play(cut, 2, 3)
    np.testing.assert_array_equal(timesteps.truncated, [[False, False, True]] * 2)
    assert not timesteps.terminated.any()
    assert (timesteps.measures["highest_tile"] >= 2).all()


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
    available = Choices((3, 2), (2,)).mask_combinations(masks)
    np.testing.assert_array_equal(available, [True, True, False, False, True, True])


def test_pictures():
    env = make(family_task("jumanji/Game2048-v1", max_episode_steps=3))
    state, _ = env.reset(jax.random.key(0))
    frames = env.frames(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), state))
    assert len(frames) == 2
    assert (frames[0].ndim, frames[0].shape[2]) == (3, 3)


@pytest.mark.parametrize(
    ("environment", "changes", "content"),
    [
        ("jumanji/Snake-v2", {}, "did you mean 'Snake-v1'"),
        (KNAPSACK, {}, "no time limit.*max_episode_steps"),
        ("jumanji/JobShop-v0", {"max_episode_steps": 9}, "10 choices at a time have 16679880978201 combinations"),
        ("jumanji/LevelBasedForaging-v0", {}, "each of its 2 agents has rewards"),
        ("jumanji/MultiCVRP-v0", {"max_episode_steps": 9}, "its actions are BoundedArray"),
        ("jumanji/Maze-v0", {"arguments": {"rows": 3}}, "cannot be made: .*rows"),
    ],
)
def test_refusals(environment, changes, content):
    with pytest.raises(LareError, match=content) as error:
        make_env(family_task(environment, **changes))
    assert "\n" not in str(error.value)


def test_draft():
    draft = draft_task("jumanji/Snake-v1")
    assert draft.missing_keys == ()
    assert "0 to 719: grid (shape 12 by 12 by 5, row by row); 720: step_count." in draft.toml
    assert "action_mask" not in draft.toml
    assert "An episode ends:\n- if no action can be performed" in draft.toml
    assert "1.0 if a fruit is eaten" not in draft.toml
    assert "max_episode_steps = 1000" in draft_task("jumanji/Game2048-v1").toml
