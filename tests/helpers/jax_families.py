"""Episodes of other packages' JAX environments, for the tests of their families."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.toy_envs import toy_spec
from lare_rl.envs.interface import EnvSpec, JaxEnv, Timestep, to_env_action
from lare_rl.tasks.spec import TaskSpec


def require_family(environment: str) -> None:
    """Skip a test, or a module of tests, without the family's package. Importing it here would turn its warnings into errors."""
    family = environment.partition("/")[0]
    packages = {"brax": ["brax", "mujoco.mjx"], "playground": ["mujoco_playground", "mujoco.mjx"]}
    for package in packages.get(family, [family]):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed", allow_module_level=True)


def family_task(environment: str, observation_size: int = 1, action_size: int = 1, **changes) -> TaskSpec:
    values = {"name": "Family", "observation_size": observation_size, "action_size": action_size}
    return toy_spec(environment=environment, **(values | changes))


def play(env: JaxEnv, n_envs: int, n_steps: int) -> tuple[Timestep, np.ndarray, Timestep]:
    """Play random actions in several environments in one compiled call.

    Return the first timesteps, and the actions and timesteps [environment, step, ...]. Episodes that have ended go on.
    """

    def step(carry, key):
        state, available = carry
        action = jax.random.uniform(key, available.shape, minval=-1, maxval=1)
        action = to_env_action(jnp.where(available, action, -jnp.inf) if env.spec.discrete else action, env.spec)
        state, timestep = env.step(state, action, key)
        return (state, timestep.available), (action, timestep)

    def unroll(key):
        state, timestep = env.reset(key)
        steps = jax.lax.scan(step, (state, timestep.available), jax.random.split(key, n_steps))[1]
        return timestep, *steps

    keys = jax.random.split(jax.random.key(0), n_envs)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(unroll))(keys))


def step_keys(n_envs: int, n_steps: int) -> tuple[jax.Array, list[jax.Array]]:
    """Return the keys of `play` in its first environment, as the packages take them: that of the reset, and those of the steps."""
    key = jax.random.split(jax.random.key(0), n_envs)[0]
    return jax.random.key_data(key), [jax.random.key_data(key) for key in jax.random.split(key, n_steps)]


def check_arrays(spec: EnvSpec, timesteps: Timestep) -> None:
    """Assert the shapes and types that the interface promises, for timesteps [environment, step, ...]."""
    lead = timesteps.terminated.shape
    agents = (*lead, spec.n_agents)
    assert timesteps.observation.shape == (*agents, spec.observation_size)
    assert timesteps.state.shape == (*lead, spec.state_size)
    assert timesteps.available.shape == (*agents, spec.action_size)
    assert timesteps.available.any(axis=-1).all()
    for values in (timesteps.observation, timesteps.state, timesteps.reward):
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
