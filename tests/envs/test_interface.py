"""The interface of environments: team means, actions in the environment's units, and `JaxEnv`s on the host."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.jax_toy_envs import Echo
from lare_rl.envs.agent_arrays import AgentArrays, make_agent
from lare_rl.envs.interface import EnvSpec, Team, team_mean, to_env_action, to_package_action
from lare_rl.envs.jax_on_host import JaxOnHost
from lare_rl.envs.play import play_steps
from lare_rl.errors import LareError

DISCRETE = EnvSpec((Team("agent", 0, 2),), observation_size=1, action_size=3, discrete=True, max_steps=1)


def slow_team_mean(values: np.ndarray, alive: np.ndarray, team: Team) -> np.ndarray:
    """One step at a time, one agent at a time, in float64."""
    means = np.zeros(values.shape[:-1])
    for step in np.ndindex(means.shape):
        living = [float(values[step][agent]) for agent in range(team.start, team.stop) if alive[step][agent]]
        means[step] = sum(living) / len(living) if living else 0
    return means


@st.composite
def steps(draw):
    shape = draw(arrays.array_shapes(min_dims=1, max_dims=3, max_side=4))
    values = draw(arrays.arrays(np.float32, shape, elements=st.floats(-1000, 1000, width=32)))
    start = draw(st.integers(0, shape[-1] - 1))
    return values, draw(arrays.arrays(bool, shape)), Team("x", start, draw(st.integers(start + 1, shape[-1])))


@settings(deadline=None, max_examples=40)
@given(samples=steps())
def test_team_mean_equals_its_twin(samples):
    # Values of up to 1000 may cancel. float32 represents each of them with an error of 3e-5.
    np.testing.assert_allclose(team_mean(*samples), slow_team_mean(*samples), atol=2e-4)


def test_discrete_action_is_the_first_largest():
    action = np.array([[0.2, 0.1, 0.9], [-5, -4, -9], [0.5, 0.5, 0.5], [-np.inf, -np.inf, -1]], np.float32)
    env_action = to_env_action(action, DISCRETE)
    np.testing.assert_array_equal(env_action, np.eye(3)[[2, 1, 0, 2]])
    assert env_action.dtype == np.float32
    many = replace(DISCRETE, action_size=10**6)  # a matrix of all one-hot rows would need 4 TB
    assert to_env_action(np.eye(1, 10**6, 7), many).argmax() == 7


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, [2, 3]),
        ({"first_choice": -1}, [1, 2]),
        ({"choice_sizes": (2, 3), "package_shape": (2,)}, [[0, 2], [1, 0]]),
        ({"choice_sizes": (2, 3), "package_shape": (2, 1)}, [[[0], [2]], [[1], [0]]]),
    ],
)
def test_package_action_of_choices(fields, expected):
    spec = EnvSpec((Team("agent", 0, 1),), 1, 6, discrete=True, max_steps=1, **fields)
    one_hot = np.eye(6, dtype=np.float32)[[2, 3]]
    np.testing.assert_array_equal(to_package_action(one_hot, spec), expected)
    np.testing.assert_array_equal(to_package_action(one_hot[1], spec), expected[1])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_package_action_is_in_its_space_at_the_bounds(dtype):
    space = Box(-0.1, 0.1, (2,), dtype)
    for spec in (
        AgentArrays([make_agent("a", space, space)]).make_spec((Team("agent", 0, 1),), max_steps=1),
        EnvSpec(
            (Team("agent", 0, 1),), 1, 2, discrete=False, max_steps=1, low=space.low[None], high=space.high[None],
            package_dtype=space.dtype,
        ),
    ):  # fmt: skip
        action = to_package_action(to_env_action(np.array([[-1, 1]], np.float32), spec)[0], spec)
        assert space.contains(action)
        np.testing.assert_array_equal(action, [space.low[0], space.high[0]])


def test_continuous_action_is_scaled_to_the_bounds_of_each_agent():
    low, high = np.array([[-1, 0], [10, 10]], np.float32), np.array([[1, 4], [20, 10]], np.float32)
    spec = EnvSpec((Team("agent", 0, 2),), 1, 2, discrete=False, max_steps=1, low=low, high=high)
    action = np.array([[[-1, -1], [1, 1]], [[0, 0.5], [-0.5, 0]], [[-9, 9], [9, -9]]], np.float32)
    env_action = [[[-1, 0], [20, 10]], [[0, 3], [12.5, 10]], [[-1, 4], [20, 10]]]
    np.testing.assert_array_equal(to_env_action(action, spec), env_action)
    np.testing.assert_allclose(to_env_action(jnp.array(action), spec), env_action, rtol=1e-6)
    int8_spec = replace(spec, low=np.full((2, 2), -100, np.int8), high=np.full((2, 2), 100, np.int8))
    np.testing.assert_array_equal(
        to_env_action(action, int8_spec).astype(int8_spec.action_dtype)[1], [[0, 50], [-50, 0]]
    )
    assert int8_spec.action_dtype == np.float32


# JaxOnHost

ON_HOST = JaxOnHost(Echo())


def assert_equal(actual, expected) -> None:
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


def test_jax_on_host_equals_the_functions():
    """A key is split before the start and before each step, so that no two of them share a key."""
    env = Echo()
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    reset_key, key = jax.random.split(jax.random.key(3))
    state, expected = reset(reset_key)
    assert_equal(ON_HOST.reset(3), expected)
    for number in range(3):
        key, step_key = jax.random.split(key)
        action = np.eye(3, dtype=np.float32)[[number % 2, 0, 1]]
        state, expected = step(state, action, step_key)
        timestep = ON_HOST.step(action)
        assert_equal(timestep, expected)
        # Code on the host computes with NumPy, also in worker processes without JAX.
        assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(timestep))


def test_jax_on_host_repeats_the_episode_of_a_seed():
    def play(seed):
        return [step for *_, step in play_steps(ON_HOST, None, np.random.default_rng(0), seed)]

    first = play(5)
    ON_HOST.reset(9)
    ON_HOST.step(np.eye(3, dtype=np.float32))
    assert_equal(play(5), first)
    observations = [[step.observation.tolist() for step in episode] for episode in (first, play(6), play(7))]
    assert observations[0] not in observations[1:]
    with pytest.raises(LareError, match="frames"):
        ON_HOST.render()
    ON_HOST.close()
