"""The fused step of TD3."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.algorithms import td3
from lare.algorithms.critics import Transitions
from lare.credit.decomposition import CreditSettings
from lare.training import learner as common
from lare.training import off_policy, replay
from recipes import recipe, steps_of, stored


def test_relabelling_is_by_the_newest_decoder():
    """One update: the critic's loss is that of the rewards of the decoder after its step, not before."""
    credit = CreditSettings(hidden=(8,), drawn_steps=4, steps=24, learning_rate=0.3)
    chosen = recipe("lare-rrdu", turn=1, credit=credit)
    learner = stored(chosen)
    after, metrics = off_policy.improve(learner, jax.random.key(0), jnp.array(0), chosen)
    draw_key, _, noise_key = jax.random.split(jax.random.key(0), 3)
    batch = replay.read(learner.replay, off_policy.draw(learner.replay, draw_key, 1, chosen).batch[0])
    losses = []
    for decoder in (learner.credit, after.credit):
        reward = common.rewards(batch, learner._replace(credit=decoder), chosen)
        seen = Transitions(batch.observation, batch.action, reward, batch.next_observation, batch.continues)
        _, key = jax.random.split(jax.random.split(noise_key, 1)[0])
        _, measured = td3.update(learner.algorithm, seen, key, jnp.array(0), chosen.algorithm)
        losses.append(float(measured["critic/loss"]))
    assert float(metrics["critic/loss"]) == pytest.approx(losses[1], rel=1e-4)
    assert losses[0] != pytest.approx(losses[1], rel=1e-2)


def test_nothing_is_expected_after_a_termination(monkeypatch):
    chosen, given, batches = recipe("dense", turn=3), steps_of(0), []
    given.terminated[given.ended] = [True, False, True, True, False]
    learner = common.store(common.init(jax.random.key(0), chosen), given, chosen)

    def update(algorithm, batch, key, number, settings):
        jax.debug.callback(lambda *rows: batches.append(rows), batch.observation, batch.continues)
        return td3_update(algorithm, batch, key, number, settings)

    td3_update = td3.update
    monkeypatch.setattr(td3, "update", update)
    off_policy.improve(learner, jax.random.key(0), jnp.array(0), chosen)
    jax.effects_barrier()
    assert len(batches) == 3
    seen = 0
    for observation, continues in batches:
        rows = [int(np.argmin(np.abs(given.observation - one).sum(axis=1))) for one in observation]
        np.testing.assert_array_equal(continues, 1.0 - given.terminated[rows])
        seen += given.terminated[rows].sum()
    assert seen


def test_seeds_in_lockstep_are_seeds_alone():
    chosen = recipe("lare-rrdu")
    functions = off_policy.compiled(chosen)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start = jax.vmap(partial(common.init, recipe=chosen))(keys)
    many = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (3, *leaf.shape)), steps_of(2))
    together, _ = functions.improve(functions.store(start, many), keys, 0)
    alone = jax.jit(partial(common.store, recipe=chosen))(common.init(keys[1], chosen), steps_of(2))
    alone, _ = jax.jit(partial(off_policy.improve, recipe=chosen))(alone, keys[1], jnp.array(0))
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-4, atol=1e-5)
