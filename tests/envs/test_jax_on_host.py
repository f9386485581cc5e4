"""Pure functions on the host: the same episodes, as NumPy."""

import jax
import numpy as np
import pytest

from helpers.jax_toys import Echo
from lare_rl.envs.jax_on_host import OnHost
from lare_rl.envs.play import steps_of
from lare_rl.errors import LareError

CHOICE = np.eye(3, dtype=np.float32)


def same(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_an_episode_is_that_of_the_functions():
    """Keys are split once before the start, and once before every step, so that no two of them share one."""
    on_host, env = OnHost(Echo()), Echo()
    begin, key = jax.random.split(jax.random.key(3))
    state, expected = env.reset(begin)
    same(on_host.reset(3), expected)
    for step in range(3):
        key, now = jax.random.split(key)
        action = CHOICE[[step % 2, 0, 1]]
        state, expected = env.step(state, action, now)
        same(on_host.step(action), expected)


def test_a_seed_is_an_episode_even_in_the_middle_of_another():
    env = OnHost(Echo())

    def played(seed):
        return [after for *_, after in steps_of(env, None, np.random.default_rng(0), seed)]

    first = played(5)
    env.reset(9)
    env.step(CHOICE[[0, 0, 0]])
    same(played(5), first)
    others = [[step.observation.tolist() for step in played(seed)] for seed in range(6, 9)]
    assert [step.observation.tolist() for step in first] not in others


def test_what_is_shown_is_numpy():
    """What runs on the host computes with NumPy, also in worker processes that have no JAX."""
    env = OnHost(Echo())
    for shown in (env.reset(0), env.step(CHOICE[[0, 0, 0]])):
        *parts, measures = shown
        assert all(isinstance(part, np.ndarray) for part in (*parts, *measures.values()))
        assert shown.observation.shape == (3, 4)
        assert (shown.observation.dtype, shown.alive.dtype) == (np.float32, bool)


def test_it_has_no_window():
    env = OnHost(Echo())
    with pytest.raises(LareError) as error:
        env.render()
    assert (
        str(error.value) == "an environment in JAX cannot be rendered step by step: its frames() draws whole episodes"
    )
    env.close()
    assert env.reset(0).alive.all()
