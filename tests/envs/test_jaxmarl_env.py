"""Environments of JaxMARL, compared with its own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family, step_keys
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import Team
from lare_rl.envs.jaxmarl_env import make
from lare_rl.errors import LareError

require_family("jaxmarl")

SPREAD = "jaxmarl/MPE_simple_spread_v3"
TAG = "jaxmarl/MPE_simple_tag_v3"


def tag_team(name: str):
    return family_task(TAG, 20, 5, name=name, agents=[f"{name}_*"], team=name)


def test_time_limit_truncates_and_keeps_the_last_observation():
    env = make(family_task(SPREAD))
    assert (env.spec.teams, env.spec.max_steps, env.spec.observation_size) == ((Team("agent", 0, 3),), 25, 18)
    _, actions, timesteps = play(env, 2, 25)
    check_arrays(env.spec, timesteps)
    np.testing.assert_array_equal(timesteps.truncated, [np.arange(25) == 24] * 2)
    assert not timesteps.terminated.any()
    assert timesteps.alive.all()
    reset_key, keys = step_keys(2, 25)
    _, state = env.env.reset(reset_key)
    observations, rewards = {}, 0.0
    for number in range(25):
        choices = {name: jnp.int32(actions[0, number, index].argmax()) for index, name in enumerate(env.env.agents)}
        observations, state, reward, _, _ = env.env.step_env(keys[number], state, choices)
        rewards += reward["agent_1"]
    last = np.stack([observations[name] for name in env.env.agents])
    np.testing.assert_allclose(timesteps.observation[0, -1], last, rtol=1e-3, atol=1e-4)
    assert timesteps.reward[0, :, 1].sum() == pytest.approx(float(rewards), rel=1e-3)


def test_teams_and_padding():
    env = make_env(family_task(TAG, 20, 5, teams=[tag_team("agent"), tag_team("adversary")]))
    assert env.spec.teams == (Team("agent", 0, 1), Team("adversary", 1, 4))
    _, timestep = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_array_equal(timestep.observation[:, 16:], np.eye(4))
    assert not timestep.observation[0, 14:16].any()  # the good agent observes less
    assert env.spec.state_size == 0
    assert make(tag_team("agent").model_copy(update={"credit_scope": "state"})).spec.state_size == 80
    with pytest.raises(LareError, match="adversary_0 is in no team"):
        make(family_task(TAG, agents=["agent_*"]))


def test_masks_states_and_units_that_die():
    env = make(family_task("jaxmarl/HeuristicEnemySMAX"))
    assert (env.spec.state_size, env.spec.max_steps, env.spec.masks_actions) == (120, 100, True)
    _, _, timesteps = play(env, 4, 60)
    check_arrays(env.spec, timesteps)
    assert timesteps.terminated.any(axis=1).all()
    for episode, last in enumerate(timesteps.terminated.argmax(axis=1)):
        alive, observation = timesteps.alive[episode], timesteps.observation[episode]
        assert (np.diff(alive[: last + 1].astype(int), axis=0) <= 0).all()
        assert not observation[: last + 1][~alive[: last + 1]].any()
        acted = alive[:last]
        assert not timesteps.reward[episode, 1 : last + 1][~acted].any()
        assert not timesteps.available[episode, :last][~acted][:, 1:].any()
    assert not timesteps.alive[:, -1].all()
