"""Environments of JaxMARL. `test_jax_families.py` compares them with its own steps."""

import jax
import numpy as np
import pytest

from helpers.jax_families import check_arrays, family_task, play, require_family
from lare_rl.envs.families import make_env
from lare_rl.envs.interface import Team
from lare_rl.envs.jaxmarl_env import make
from lare_rl.errors import LareError

require_family("jaxmarl")

TAG = "jaxmarl/MPE_simple_tag_v3"


def tag_team(name: str):
    return family_task(TAG, 20, 5, name=name, agents=[f"{name}_*"], team=name)


def test_teams_and_padding():
    with pytest.raises(LareError, match="List the teams in the order"):  # the agents' indices are entries
        make_env(family_task(TAG, 20, 5, teams=[tag_team("agent"), tag_team("adversary")]))
    env = make_env(family_task(TAG, 20, 5, teams=[tag_team("adversary"), tag_team("agent")]))
    assert env.spec.teams == (Team("adversary", 0, 3), Team("agent", 3, 4))
    _, timestep = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_array_equal(timestep.observation[:, 16:], np.eye(4))
    assert not timestep.observation[3, 14:16].any()  # the good agent observes less
    assert env.spec.state_size == 0
    assert make(tag_team("agent").model_copy(update={"credit_scope": "state"})).spec.state_size == 80


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
