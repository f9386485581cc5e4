"""Environments of gymnax. `test_jax_families.py` compares them with its own steps."""

import numpy as np

from helpers.jax_families import family_task, play, require_family
from lare_rl.envs.gymnax_env import make

require_family("gymnax")


def test_continuous_actions_and_parameters():
    env = make(family_task("gymnax/Pendulum-v1", arguments={"max_torque": 1.5}))
    np.testing.assert_array_equal(env.spec.high, [[1.5]])
    assert (env.spec.discrete, env.spec.max_steps, env.spec.observation_size) == (False, 200, 3)


def test_number_of_a_state_is_one_hot():
    env = make(family_task("gymnax/FrozenLake-misc", arguments={"is_slippery": False}))
    first, _, _ = play(env, 1, 1)
    np.testing.assert_array_equal(first.observation[0, 0], np.arange(16) == 0)
