"""The fused step: what each method reads and is rewarded with."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.algorithms.td3 import TD3Settings
from lare.credit.decomposition import CreditSettings
from lare.credit.methods import METHODS, TABLE, Encoder, Fit, Reward
from lare.training import off_policy, replay
from lare.training.off_policy import Recipe
from lare.training.replay import Step

LENGTHS = (5, 12, 3, 9, 12)


def recipe(method, **changes):
    values = {
        "method": METHODS[method],
        "td3": TD3Settings(hidden=(8,), batch_size=8),
        "credit": CreditSettings(hidden=(8,), drawn_steps=4, steps=24),
        "scale_rewards": False,
        "observation_size": 3,
        "action_size": 2,
        "factors": 2 if METHODS[method].encoder is Encoder.LATENT else 0,
        "longest_episode": 12,
        "capacity": 100,
    }
    return Recipe(**(values | changes))


def steps(factors):
    rng, total = np.random.default_rng(0), sum(LENGTHS)
    s, a, z, n = (rng.normal(size=(total, size)).astype(np.float32) for size in (3, 2, factors, 3))
    ended = np.zeros(total, bool)
    ended[np.cumsum(LENGTHS) - 1] = True
    return Step(s, a, z, rng.normal(size=total).astype(np.float32), n, np.zeros(total, bool), ended)


def stored(chosen):
    learner = off_policy.init(jax.random.key(0), chosen)
    return jax.jit(partial(off_policy.store, recipe=chosen))(learner, steps(chosen.factors))


def test_store_keeps_statistics_of_what_came():
    learner, given = stored(recipe("lare-rrdu")), steps(2)
    np.testing.assert_allclose(learner.credit.moments.mean, given.factors.mean(axis=0), rtol=1e-4)
    means = [part.mean() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])]
    assert float(learner.scale.mean_square) == pytest.approx(np.mean(np.square(means)), rel=1e-4)
    np.testing.assert_array_equal(learner.scale, learner.credit.scale)


def test_raw_features_are_s_a_and_the_change():
    chosen = recipe("rrdu")
    drawn = replay.read(stored(chosen).replay, jnp.array([7]))
    want = np.concatenate([drawn.observation, drawn.action, drawn.observation - drawn.next_observation], axis=1)
    np.testing.assert_array_equal(off_policy.features(drawn, chosen.method), want)
    assert want.shape[1] == chosen.features == 8


@pytest.mark.parametrize("key", range(4))
def test_whole_episodes_are_masked_never_padded(key):
    chosen = recipe("rd")
    held = stored(chosen).replay
    drawn = off_policy.draw_whole_episodes(held, jax.random.key(key), chosen)
    lengths, counts = np.asarray(drawn.episodes.length), np.asarray(drawn.episodes.counts)
    # About 24 steps: mean length 8.2, so two episodes, if they fit.
    assert 1 <= counts.sum() <= 2
    assert lengths[counts > 0].sum() <= 24
    for place in np.flatnonzero(counts):
        rows = np.asarray(drawn.steps)[np.asarray(drawn.episode) == place]
        np.testing.assert_array_equal(rows, int(drawn.episodes.first[place]) + np.arange(lengths[place]))
    assert set(np.asarray(drawn.episode)) <= {*np.flatnonzero(counts), chosen.credit.steps}


def test_parts_of_episodes_stay_inside_them():
    chosen = recipe("rrdu")
    drawn = off_policy.draw_parts_of_episodes(stored(chosen).replay, jax.random.key(0), 7, chosen)
    first = np.repeat(np.asarray(drawn.episodes.first), 4, axis=1)
    length = np.repeat(np.asarray(drawn.episodes.length), 4, axis=1)
    assert drawn.steps.shape == (7, 24)
    assert (np.asarray(drawn.steps) >= first).all()
    assert (np.asarray(drawn.steps) < first + length).all()


@pytest.mark.parametrize("method", ["dense", "episodic", "lare-rrdu"])
@pytest.mark.parametrize("scale_rewards", [False, True])
def test_rewards(method, scale_rewards):
    chosen = recipe(method, scale_rewards=scale_rewards)
    learner = stored(chosen)
    drawn = replay.read(learner.replay, jnp.arange(sum(LENGTHS)))
    got, unit = off_policy.rewards(drawn, learner, chosen), off_policy.magnitude(learner.scale)
    got = np.asarray(got) * (unit if scale_rewards else 1)
    given = steps(chosen.factors)
    if chosen.method.reward is Reward.TRUE:
        np.testing.assert_allclose(got, given.reward, rtol=1e-5)
    elif chosen.method.reward is Reward.EPISODIC:
        returns = [part.sum() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])]
        np.testing.assert_allclose(got[given.ended], returns, rtol=1e-4, atol=1e-6)
        assert not got[~given.ended].any()
    else:
        assert got.std() > 0


@pytest.mark.parametrize("method", [method.name for method in TABLE if not method.for_many_only])
def test_every_method_improves_and_is_finite(method):
    chosen = recipe(method)
    learner, metrics = jax.jit(partial(off_policy.improve, updates=4, recipe=chosen))(
        stored(chosen), jax.random.key(0), jnp.array(0)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((learner.algorithm, learner.credit, metrics)))
    assert ("credit/loss" in metrics) == (chosen.method.fit is not None)


def test_relabelling_is_by_the_newest_decoder():
    """One update: the critic's loss is that of the rewards of the decoder after its step, not before."""
    chosen = recipe("lare-rrdu", credit=CreditSettings(hidden=(8,), drawn_steps=4, steps=24, learning_rate=0.3))
    learner = stored(chosen)
    after, metrics = off_policy.improve(learner, jax.random.key(0), jnp.array(0), 1, chosen)
    draw_key, noise_key = jax.random.split(jax.random.key(0))
    batch = replay.read(learner.replay, off_policy.draw(learner.replay, draw_key, 1, chosen).batch[0])
    losses = []
    for decoder in (learner.credit, after.credit):
        reward = off_policy.rewards(batch, learner._replace(credit=decoder), chosen)
        seen = off_policy.td3.Transitions(
            batch.observation, batch.action, reward, batch.next_observation, batch.continues
        )
        key = jax.random.split(noise_key, 1)[0]
        _, measured = off_policy.td3.update(learner.algorithm, seen, key, jnp.array(False), chosen.td3)
        losses.append(float(measured["critic/loss"]))
    assert float(metrics["critic/loss"]) == pytest.approx(losses[1], rel=1e-4)
    assert losses[0] != pytest.approx(losses[1], rel=1e-2)


def test_seeds_in_lockstep_are_seeds_alone():
    chosen = recipe("lare-rrdu")
    functions = off_policy.compiled(chosen, 3)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start = jax.vmap(partial(off_policy.init, recipe=chosen))(keys)
    many = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (3, *leaf.shape)), steps(2))
    together, _ = functions.improve(functions.store(start, many), keys, 0)
    alone = jax.jit(partial(off_policy.store, recipe=chosen))(off_policy.init(keys[1], chosen), steps(2))
    alone, _ = jax.jit(partial(off_policy.improve, updates=3, recipe=chosen))(alone, keys[1], jnp.array(0))
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-4, atol=1e-5)


def test_every_fit_has_a_method():
    assert {method.fit for method in TABLE} >= set(Fit)
