"""Compiled functions of several seeds in lockstep give what each seed gives alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_twins import assert_close
from helpers.small_configs import (
    ONE_AGENT,
    TOTAL,
    TWO_TEAMS,
    add_steps,
    random_factors,
    random_steps,
    small_config,
    store_seeds,
)
from lare_rl.training import off_policy, on_policy
from lare_rl.training.compiled import compile_functions
from lare_rl.training.decoder_fits import fit_repeatedly


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "algorithm", "env"),
    [("lare-rrdu", "td3", ONE_AGENT), ("lare-rd", "ppo", ONE_AGENT), ("lare-rd", "ippo", TWO_TEAMS)],
)
def test_train_step_of_seeds_in_lockstep(method, algorithm, env):
    fits_first = algorithm != "td3"
    changes = {"rollout_steps": TOTAL, "n_envs": 2} if fits_first else {}
    config = small_config(method, algorithm, env, **changes)
    functions = compile_functions(config)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start, steps = functions.init(keys), random_steps(env, config.n_envs)
    stacked = jax.tree.map(lambda leaf: np.stack([leaf] * 3), (steps, random_factors(config, steps)))
    alone = add_steps(jax.tree.map(lambda leaf: np.asarray(leaf)[1], start), config, steps, learn=True)

    together = functions.learn_returns(store_seeds(config)(start, *stacked))
    if fits_first:
        together, _ = functions.fit(together, keys)
        alone = alone._replace(reward_sources=jax.jit(partial(fit_repeatedly, config=config))(alone, keys[1])[0])
        train = jax.jit(partial(on_policy._train_seed, config=config))
        alone, _ = train(alone, steps, keys[1], jnp.array(40))
    else:
        alone, _ = jax.jit(partial(off_policy._train_seed, config=config))(alone, keys[1], jnp.array(40))
    together, _ = functions.train_step(together, stacked[0], keys, 40)
    assert_close(jax.tree.map(lambda leaf: np.asarray(leaf)[1], together), alone, 1e-3, 1e-4)
