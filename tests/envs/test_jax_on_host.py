"""Pure functions on the host: the same episodes, as NumPy."""

import jax
import numpy as np
import pytest

from helpers.jax_toy_envs import Echo
from lare_rl.envs.jax_on_host import JaxOnHost
from lare_rl.envs.play import play_steps
from lare_rl.errors import LareError

CHOICE = np.eye(3, dtype=np.float32)


def same(actual, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, actual, other)


def test_an_episode_is_that_of_the_functions():
    """Keys are split once before the start, and once before every step, so that no two of them share one."""
    on_host, env = JaxOnHost(Echo()), Echo()
    begin, key = jax.random.split(jax.random.key(3))
    state, expected = env.reset(begin)
    same(on_host.reset(3), expected)
    for step in range(3):
        key, now = jax.random.split(key)
        action = CHOICE[[step % 2, 0, 1]]
        state, expected = env.step(state, action, now)
        same(on_host.step(action), expected)


def test_a_seed_is_an_episode_even_in_the_middle_of_another():
    env = JaxOnHost(Echo())

    def played(seed):
        return [after for *_, after in play_steps(env, None, np.random.default_rng(0), seed)]

    first = played(5)
    env.reset(9)
    env.step(CHOICE[[0, 0, 0]])
    same(played(5), first)
    expected_arrays = [[step.observation.tolist() for step in played(seed)] for seed in range(6, 9)]
    assert [step.observation.tolist() for step in first] not in expected_arrays


def test_what_is_shown_is_numpy():
    """What runs on the host computes with NumPy, also in worker processes that have no JAX."""
    env = JaxOnHost(Echo())
    for timestep in (env.reset(0), env.step(CHOICE[[0, 0, 0]])):
        *arrays, measures = timestep
        assert all(isinstance(array, np.ndarray) for array in (*arrays, *measures.values()))
        assert timestep.observation.shape == (3, 4)
        assert (timestep.observation.dtype, timestep.alive.dtype) == (np.float32, bool)


def test_it_has_no_window():
    env = JaxOnHost(Echo())
    with pytest.raises(LareError, match="frames"):
        env.render()
    env.close()
    assert env.reset(0).alive.all()
