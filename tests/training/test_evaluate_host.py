"""Evaluations with fewer environments than episodes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import small_config
from helpers.toy_envs import pick_spec
from lare_rl.envs.families import load_env_spec, picklable_maker
from lare_rl.envs.vec_env import LocalVecEnv
from lare_rl.training.compiled import compile_functions, init_seeds
from lare_rl.training.streams import seed_keys
from lare_rl.training.unroll_host import evaluate_policy_on_host

SEEDS = (0, 3)


@pytest.mark.parametrize("deterministic", [False, True])
def test_an_episode_does_not_depend_on_the_number_of_environments(deterministic):
    """Neither its initial state nor the choices that a policy samples."""
    maker = picklable_maker(pick_spec())
    config = replace(small_config("dense", "ppo", load_env_spec(pick_spec())), deterministic=deterministic)
    functions = compile_functions(config)
    actor = functions.get_actor(init_seeds(functions, seed_keys(jnp.array(SEEDS), 0)), 0)
    n_calls, n_done = [], []
    results = []
    for width in (5, 2, 1):
        with LocalVecEnv([maker] * (len(SEEDS) * width)) as envs:
            n_calls.append(0)

            def count():
                n_calls[-1] += 1

            results.append(
                evaluate_policy_on_host(envs, config, actor, SEEDS, 5, first=1, on_step=count, on_episode=n_done.append)
            )
    assert n_calls == [20, 60, 100]
    assert n_done == [5, 2, 4, 5, 1, 2, 3, 4, 5]
    assert results[0].returns.shape == (2, 5, 1)
    assert len(np.unique(results[0].returns)) > 2
    for result in results[1:]:
        np.testing.assert_array_equal(result.returns, results[0].returns)
        np.testing.assert_array_equal(result.lengths, results[0].lengths)
