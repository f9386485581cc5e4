"""Environments of MuJoCo Playground, compared with its own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from lare_rl.envs.playground_env import make

require_family("playground")

PENDULUM = "playground/PendulumSwingup"


def test_steps_and_time_limit():
    env = make(family_task(PENDULUM, arguments={"episode_length": 3}))
    assert (env.spec.observation_size, env.spec.action_size, env.spec.max_steps) == (3, 1, 3)
    first, actions, timesteps = play(env, 2, 3)
    check_arrays(env.spec, timesteps)
    np.testing.assert_array_equal(timesteps.truncated, [[False, False, True]] * 2)
    assert not timesteps.terminated.any()
    state, step = jax.jit(env.env.reset)(step_keys(2, 3)[0]), jax.jit(env.env.step)
    np.testing.assert_allclose(first.observation[0, 0], state.obs, rtol=1e-4, atol=1e-5)
    rewards = 0.0
    for number in range(3):
        state = step(state, jnp.asarray(actions[0, number, 0]))
        rewards += state.reward
    np.testing.assert_allclose(timesteps.observation[0, -1, 0], state.obs, rtol=1e-3, atol=1e-4)
    assert timesteps.reward[0].sum() == pytest.approx(float(rewards), rel=1e-3)


def test_deprecated_attributes_of_a_model_write_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make(family_task("playground/CheetahRun"))
    assert list(tmp_path.iterdir()) == []
