"""The updates of TD3 in one compiled call."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.recipes import (
    ALONE,
    config_of,
    factors_for,
    jitted,
    paid_by,
    read,
    steps_of,
    store_seeds,
    stored,
    untrained,
    with_steps,
)
from lare_rl.algorithms import td3
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.data import replay
from lare_rl.training import learner as common
from lare_rl.training import off_policy
from lare_rl.training.compiled import compiled


def test_relabelling_is_by_the_newest_decoder():
    """One update: the critic's loss is that of the rewards of the decoder after its step, not before."""
    credit = CreditSettings(hidden=(8,), drawn_steps=4, steps=24, learning_rate=0.3)
    config = config_of("lare-rrdu", rollout_steps=1, credit=credit)
    learner = stored(config)
    after, metrics = jitted(off_policy.improve_one, config)(learner, steps_of(), jax.random.key(0), jnp.array(0))
    draw_key, _, noise_key = jax.random.split(jax.random.key(0), 3)
    index = jax.tree.map(lambda leaf: leaf[0], off_policy.sample(learner.replay, draw_key, 1, config).batch)
    batch, losses = read(learner.replay, index), []
    update = jax.jit(partial(td3.update, settings=config.hyperparameters))
    for decoder in (learner.credit, after.credit):
        reward = jitted(common.rewards, config)(batch, common.Paid(decoder, learner.scale))
        _, key = jax.random.split(jax.random.split(noise_key, 1)[0])
        seen = off_policy.transitions(batch, reward)
        _, measured = update(learner.algorithm, seen, key, jnp.array(0))
        losses.append(float(measured["critic/loss"]))
    assert float(metrics["critic/loss"]) == pytest.approx(losses[1], rel=1e-4)
    assert losses[0] != pytest.approx(losses[1], rel=1e-2)


@pytest.mark.parametrize("envs", [1, 2])
def test_an_update_for_each_step_and_nothing_is_expected_after_a_termination(envs, monkeypatch):
    config, given, batches = config_of("dense", rollout_steps=3, environments=envs), steps_of(envs=envs), []
    ends = np.argwhere(given.ended)
    given.after.terminated[tuple(ends[::2].T)] = True
    learner = with_steps(untrained(config), config, given)

    def update(algorithm, batch, key, number, settings):
        jax.debug.callback(lambda *rows: batches.append(rows), number, *batch)
        return td3_update(algorithm, batch, key, number, settings)

    td3_update = td3.update
    monkeypatch.setattr(td3, "update", update)
    off_policy.improve_one(learner, given, jax.random.key(0), jnp.array(10), config)
    jax.effects_barrier()
    assert sorted(int(number) for number, *_ in batches) == list(range(10, 10 + 3 * envs))
    seen, flat = 0, [rows.reshape(-1, *rows.shape[2:]) for rows in (given.before.observation, given.after.observation)]
    terminated, reward = given.after.terminated.ravel(), given.after.reward.ravel()
    for _, observation, action, paid, led_to, continues in batches:
        rows = [int(np.argmin(np.abs(flat[0][:, 0] - one).sum(axis=1))) for one in observation]
        np.testing.assert_array_equal(continues, 1.0 - terminated[rows])
        np.testing.assert_array_equal(led_to, flat[1][rows, 0])
        np.testing.assert_array_equal(action, given.action.reshape(-1, ALONE.action_size)[rows])
        np.testing.assert_array_equal(paid, reward[rows])
        seen += terminated[rows].sum()
    assert seen


def test_scaled_rewards_are_those_in_units_of_the_mean_return():
    plain, scaled = config_of("dense"), config_of("dense", scale_rewards=True)
    learner = stored(plain)
    draw = replay.read(learner.replay, off_policy.sample(learner.replay, jax.random.key(0), 1, plain).batch)
    one, other = (jitted(common.rewards, config)(draw, paid_by(learner)) for config in (plain, scaled))
    np.testing.assert_allclose(other, one / jnp.sqrt(learner.scale[0].mean_square), rtol=1e-5)


def test_seeds_in_lockstep_are_seeds_alone():
    config = config_of("lare-rrdu")
    functions = compiled(config)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start, steps = functions.init(keys), steps_of()
    many, factors = (
        jax.tree.map(lambda leaf: np.stack([leaf] * 3), part) for part in (steps, factors_for(config, steps))
    )
    alone = jax.tree.map(lambda leaf: np.asarray(leaf)[1], start)
    together, _ = functions.improve(functions.learn_returns(store_seeds(config)(start, many, factors)), many, keys, 0)
    alone = with_steps(alone, config, steps, tell=True)
    alone, _ = jax.jit(partial(off_policy.improve_one, config=config))(alone, steps, keys[1], jnp.array(0))
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(np.asarray(a)[1], b, rtol=1e-4, atol=1e-5)
