"""What an environment is: the mean of a team, actions in units, and which classes are which kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from helpers.host_envs import ToyHostEnv
from helpers.jax_toy_envs import Echo
from helpers.toy_envs import toy_spec
from lare_rl.envs.gymnasium_env import GymnasiumEnv
from lare_rl.envs.interface import EnvSpec, HostEnv, JaxEnv, Team, team_mean, to_env_action
from lare_rl.envs.jax_on_host import JaxOnHost
from lare_rl.envs.particles.particle_env import ParticleJaxEnv
from lare_rl.envs.smax.smax_env import SMAX

CHOICES = EnvSpec((Team("agent", 0, 2),), observation_size=1, action_size=3, discrete=True, max_steps=1)


def slow_team_mean(values: np.ndarray, alive: np.ndarray, team: Team) -> np.ndarray:
    """One step at a time, one agent at a time, in float64."""
    means = np.zeros(values.shape[:-1])
    for step in np.ndindex(means.shape):
        mask = [float(values[step][agent]) for agent in range(team.start, team.stop) if alive[step][agent]]
        means[step] = sum(mask) / len(mask) if mask else 0
    return means


@pytest.mark.parametrize(
    ("alive", "team", "mean"),
    [
        ([True, True, True], Team("all", 0, 3), 3.0),
        ([True, False, True], Team("all", 0, 3), 4.5),
        ([False, True, False], Team("all", 0, 3), 0.0),
        ([False, False, False], Team("all", 0, 3), 0.0),
        ([True, True, True], Team("last", 1, 3), 4.0),
        ([True, True, False], Team("last", 2, 3), 0.0),
    ],
)
def test_the_mean_is_over_the_living_of_the_team(alive, team, mean):
    values = np.array([1, 0, 8], np.float32)
    assert team_mean(values, np.array(alive), team) == mean
    assert team_mean(jnp.array(values), jnp.array(alive), team) == mean


@st.composite
def steps(draw):
    shape = draw(arrays.array_shapes(min_dims=1, max_dims=3, max_side=4))
    values = draw(arrays.arrays(np.float32, shape, elements=st.floats(-1000, 1000, width=32)))
    start = draw(st.integers(0, shape[-1] - 1))
    return values, draw(arrays.arrays(bool, shape)), Team("some", start, draw(st.integers(start + 1, shape[-1])))


@given(samples=steps())
def test_the_mean_is_that_of_the_slow_twin(samples):
    values, alive, team = samples
    # Values of up to 1000 may cancel, and float32 keeps each of them to 3e-5.
    np.testing.assert_allclose(team_mean(values, alive, team), slow_team_mean(values, alive, team), atol=2e-4)


def test_the_mean_and_the_units_are_the_same_when_compiled():
    """A tracer is no array of NumPy: which functions are meant must be told from its absence."""
    values, alive, team = np.array([[1, 0, 8]], np.float32), np.array([[True, False, True]]), Team("all", 0, 3)
    assert jax.jit(lambda values, alive: team_mean(values, alive, team))(values, alive).tolist() == [4.5]
    action = np.array([[0.1, 0.3, 0.2], [0.5, -1, 0]], np.float32)
    rows = jax.jit(lambda action: to_env_action(action, CHOICES))(action)
    np.testing.assert_array_equal(rows, to_env_action(action, CHOICES))


@pytest.mark.parametrize(
    ("action", "row"),
    [
        ([0.2, 0.1, 0.9], [0, 0, 1]),
        ([-5, -4, -9], [0, 1, 0]),
        ([0.5, 0.5, 0.5], [1, 0, 0]),
        ([-np.inf, -np.inf, -1], [0, 0, 1]),
    ],
)
def test_a_choice_is_the_largest_number_and_the_first_of_equals(action, row):
    env_action = to_env_action(np.array([action, [0, 0, 1]], np.float32), CHOICES)
    np.testing.assert_array_equal(env_action, [row, [0, 0, 1]])
    assert env_action.dtype == np.float32


def test_every_agent_has_bounds_of_its_own():
    """Whatever axes are in front, and in JAX as in NumPy."""
    low, high = np.array([[-1, 0], [10, 10]], np.float32), np.array([[1, 4], [20, 10]], np.float32)
    spec = EnvSpec((Team("agent", 0, 2),), 1, 2, discrete=False, max_steps=1, low=low, high=high)
    action = np.array([[[-1, -1], [1, 1]], [[0, 0.5], [-0.5, 0]], [[-9, 9], [9, -9]]], np.float32)
    env_action = [[[-1, 0], [20, 10]], [[0, 3], [12.5, 10]], [[-1, 4], [20, 10]]]
    np.testing.assert_array_equal(to_env_action(action, spec), env_action)
    np.testing.assert_allclose(to_env_action(jnp.array(action), spec), env_action, rtol=1e-6)


def test_agents_are_counted_over_all_teams():
    teams = Team("cat", 0, 2), Team("mouse", 2, 5)
    spec = EnvSpec(teams, 1, 1, discrete=True, max_steps=1)
    assert spec.n_agents == 5
    assert [team.n_agents for team in teams] == [2, 3]
    assert list(range(5))[teams[1].agents] == [2, 3, 4]


@pytest.mark.parametrize(
    ("env", "is_jax"),
    [
        (lambda: ParticleJaxEnv("CN-6"), True),
        (lambda: SMAX("2s3z"), True),
        (Echo, True),
        (ToyHostEnv, False),
        (lambda: GymnasiumEnv(toy_spec()), False),
        (lambda: JaxOnHost(Echo()), False),
    ],
)
def test_an_environment_is_one_of_two_kinds(env, is_jax):
    """`make_env` closes a `HostEnv` only, and `make_host_env` wraps all others."""
    env_object = env()
    assert (isinstance(env_object, JaxEnv), isinstance(env_object, HostEnv)) == (is_jax, not is_jax)
