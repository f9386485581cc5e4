"""The adapter of Brax and Playground, on a toy with the same functions. `test_jax_families.py` compares it with their own steps."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play
from lare_rl.envs.robot_env import adapt_robot
from lare_rl.errors import LareError


class ToyState(NamedTuple):
    """The fields of a state of Brax that the adapter reads."""

    obs: Any
    reward: Any
    done: Any
    metrics: Any
    time: Any


class ToyRobot:
    """Observes and earns its time. It ends at `end`, and its simulator diverges at `nan`."""

    action_size = 1

    def __init__(self, end=99, nan=99, keys=("state", "privileged_state")):
        self.end, self.nan, self.keys = end, nan, keys

    def make_state(self, time, reward):
        value = jnp.where(time >= self.nan, jnp.nan, time)
        observation = {key: jnp.full(size, value) for size, key in enumerate(self.keys, start=1)}
        return ToyState(observation, reward, jnp.float32(time >= self.end), {"time": value}, time)

    def reset(self, rng):
        return self.make_state(jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return self.make_state(state.time + 1, jnp.where(state.time + 1 >= self.nan, jnp.nan, state.time + 1))


def make_toy(action_repeat=1, measures=(), **toy):
    task = family_task("brax/toy", measures=list(measures))
    return adapt_robot(ToyRobot(**toy), task, 4, lambda states: [], action_repeat)


def play_toy(**toy):
    env = make_toy(**toy)
    _, _, timesteps = play(env, 2, 4)
    check_arrays(env.spec, timesteps)
    return jax.tree.map(lambda values: values[0], timesteps)


def test_time_limit_truncates():
    timesteps = play_toy(measures=["time"])
    np.testing.assert_array_equal(timesteps.observation[:, 0, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(timesteps.state, np.transpose([[1, 2, 3, 4]] * 2))  # what only a critic may see
    np.testing.assert_array_equal(timesteps.reward[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(timesteps.measures["time"], [1, 2, 3, 4])
    np.testing.assert_array_equal(timesteps.truncated, [False, False, False, True])
    assert not timesteps.terminated.any()


def test_ends_and_sums():
    """`done` terminates, and so does a simulator that has diverged. A repeated action adds rewards."""
    np.testing.assert_array_equal(play_toy(end=3).terminated[:3], [False, False, True])
    timesteps = play_toy(nan=3, measures=["time"])
    np.testing.assert_array_equal(timesteps.measures["time"][:3], [1, 2, 0])
    np.testing.assert_array_equal(timesteps.terminated[:3], [False, False, True])
    np.testing.assert_array_equal(timesteps.observation[:3, 0, 0], [1, 2, 2])
    np.testing.assert_array_equal(timesteps.reward[:3, 0], [1, 2, 0])
    timesteps = play_toy(action_repeat=2)
    np.testing.assert_array_equal(timesteps.observation[:, 0, 0], [2, 4, 6, 8])
    np.testing.assert_array_equal(timesteps.reward[:, 0], [3, 7, 11, 15])
    with pytest.raises(LareError, match="observes pixels/view_0, but not 'state'"):
        make_toy(keys=("pixels/view_0",))
