"""Environments of Brax, compared with its own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from lare_rl.envs.brax_env import make

require_family("brax")

pytestmark = pytest.mark.filterwarnings("ignore:Accessing .* directly from:DeprecationWarning")

PENDULUM = "brax/inverted_pendulum"


def test_last_observation_is_the_terminal_state():
    env = make(family_task(PENDULUM, max_episode_steps=30, arguments={"backend": "spring"}))
    assert (env.spec.observation_size, env.spec.action_size, env.spec.max_steps) == (4, 1, 30)
    _, actions, timesteps = play(env, 2, 30)
    check_arrays(env.spec, timesteps)
    np.testing.assert_array_equal(timesteps.truncated, [np.arange(30) == 29] * 2)
    last = int(timesteps.terminated[0].argmax())
    assert timesteps.terminated[0, last]
    assert abs(timesteps.observation[0, last, 0, 1]) > 0.2  # the pole has fallen
    state, step = jax.jit(env.env.reset)(step_keys(2, 30)[0]), jax.jit(env.env.step)
    for number in range(last + 1):
        state = step(state, jnp.asarray(actions[0, number, 0]))
    np.testing.assert_allclose(timesteps.observation[0, last, 0], state.obs, rtol=1e-3, atol=1e-4)
    assert timesteps.reward[0, : last + 1].sum() == last + 1


def test_deprecated_attributes_of_a_model_write_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make(family_task("brax/halfcheetah"))
    assert list(tmp_path.iterdir()) == []
