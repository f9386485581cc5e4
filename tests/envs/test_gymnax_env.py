"""Environments of gymnax, compared with its own steps."""

import numpy as np

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from lare_rl.envs.gymnax_env import make
from lare_rl.envs.placement import load_env_spec

require_family("gymnax")

CARTPOLE = "gymnax/CartPole-v1"


def test_last_observation_is_the_terminal_state():
    env = make(family_task(CARTPOLE))
    first, actions, timesteps = play(env, 4, 60)
    check_arrays(env.spec, timesteps)
    ended = timesteps.terminated.argmax(axis=1)
    assert timesteps.terminated.any(axis=1).all()
    assert not timesteps.truncated.any()
    for index, last in enumerate(ended):
        position, _, angle, _ = timesteps.observation[index, last, 0]
        assert abs(position) > 2.4 or abs(angle) > 0.2095
        assert timesteps.reward[index, : last + 1].sum() == last + 1
    reset_key, keys = step_keys(4, 60)
    observation, state = env.env.reset_env(reset_key, env.env.default_params)
    np.testing.assert_array_equal(first.observation[0, 0], observation)
    for number in range(ended[0] + 1):
        action = actions[0, number, 0].argmax()
        observation, state, *_ = env.env.step_env(keys[number], state, action, env.env.default_params)
        np.testing.assert_allclose(timesteps.observation[0, number, 0], observation, rtol=1e-4, atol=1e-6)


def test_time_limit_truncates():
    env = make(family_task(CARTPOLE, max_episode_steps=5))
    assert env.spec.max_steps == 5
    _, _, timesteps = play(env, 2, 5)
    assert timesteps.truncated[:, 4].all()
    assert not timesteps.truncated[:, :4].any()
    assert not timesteps.terminated.any()


def test_continuous_actions_and_parameters():
    env = make(family_task("gymnax/Pendulum-v1", arguments={"max_torque": 1.5}))
    np.testing.assert_array_equal(env.spec.high, [[1.5]])
    assert (env.spec.discrete, env.spec.max_steps, env.spec.observation_size) == (False, 200, 3)


def test_number_of_a_state_is_one_hot():
    env = make(family_task("gymnax/FrozenLake-misc", arguments={"is_slippery": False}))
    first, _, _ = play(env, 1, 1)
    np.testing.assert_array_equal(first.observation[0, 0], np.arange(16) == 0)


def test_task_matches_its_environment():
    task = family_task(CARTPOLE, 4, 2, measures=["discount"])
    assert load_env_spec(task).measures == ("discount",)
