"""The adapter of Brax and Playground: on a toy with the same functions, and compared with their own steps."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from helpers.long_tests import long_case
from lare_rl.envs.families import make_env
from lare_rl.envs.robot_env import adapt_robot
from lare_rl.errors import LareError

pytestmark = pytest.mark.filterwarnings("ignore:Accessing .* directly from:DeprecationWarning")


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


@pytest.mark.parametrize(
    ("environment", "arguments", "sizes", "ends"),
    [
        long_case("brax/inverted_pendulum", {"backend": "spring"}, (4, 1, 30), True),
        long_case("playground/PendulumSwingup", {"episode_length": 3}, (3, 1, 3), False),
    ],
)
def test_last_observation_is_the_terminal_state(environment, arguments, sizes, ends):
    require_family(environment)
    limit, n_steps = (30 if ends else None), sizes[2]
    env = make_env(family_task(environment, *sizes[:2], max_episode_steps=limit, arguments=arguments))
    assert (env.spec.observation_size, env.spec.action_size, env.spec.max_steps) == sizes
    first, actions, timesteps = play(env, 2, n_steps)
    check_arrays(env.spec, timesteps)
    np.testing.assert_array_equal(timesteps.truncated, [np.arange(n_steps) == n_steps - 1] * 2)
    assert timesteps.terminated[0].any() == ends
    last = int(timesteps.terminated[0].argmax()) if ends else n_steps - 1
    assert not ends or abs(timesteps.observation[0, last, 0, 1]) > 0.2  # the pole has fallen
    state, step, rewards = jax.jit(env.env.reset)(step_keys(2, n_steps)[0]), jax.jit(env.env.step), 0.0
    np.testing.assert_allclose(first.observation[0, 0], state.obs, rtol=1e-4, atol=1e-5)
    for action in actions[0, : last + 1, 0]:
        state = step(state, jnp.asarray(action))
        rewards += float(state.reward)
    np.testing.assert_allclose(timesteps.observation[0, last, 0], state.obs, rtol=1e-3, atol=1e-4)
    assert timesteps.reward[0, : last + 1].sum() == pytest.approx(rewards, rel=1e-3)


@pytest.mark.parametrize("environment", ["brax/halfcheetah", long_case("playground/CheetahRun")])
def test_deprecated_attributes_of_a_model_write_no_log(environment, tmp_path, monkeypatch):
    require_family(environment)
    monkeypatch.chdir(tmp_path)
    make_env(family_task(environment, 17, 6))
    assert list(tmp_path.iterdir()) == []
