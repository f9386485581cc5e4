"""The training step of PPO for a single agent."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.algorithms.ppo import PPOSettings
from lare.credit.methods import Reward
from lare.normalise import standardise
from lare.training import learner as common
from lare.training import on_policy
from recipes import LENGTHS, recipe, steps_of, stored

ppo = partial(recipe, algorithm=PPOSettings(hidden=(8,), minibatch_size=5, epochs=2), turn=20, fit_updates=3)


@pytest.mark.parametrize("method", ["dense", "episodic", "lare-rrdu"])
def test_the_rollout_is_the_newest_steps(method):
    chosen = ppo(method)
    learner, given = stored(chosen), steps_of(chosen.factors)
    taken = on_policy.rollout(learner, chosen)
    newest = jax.tree.map(lambda leaf: leaf[-20:], given)
    np.testing.assert_array_equal(taken.action[:, 0], newest.action)
    np.testing.assert_array_equal(taken.ended[:, 0], newest.ended)
    # Nothing has been seen as yet: observations are as they are.
    np.testing.assert_allclose(taken.observation[:, 0], newest.observation, rtol=1e-5)
    reward = np.asarray(taken.reward[:, 0])
    if chosen.method.reward is Reward.TRUE:
        np.testing.assert_allclose(reward, newest.reward, rtol=1e-6)
    elif chosen.method.reward is Reward.EPISODIC:
        returns = [part.sum() for part in np.split(given.reward, np.cumsum(LENGTHS)[:-1])]
        np.testing.assert_allclose(reward[newest.ended], returns[-2:], rtol=1e-4)
        assert not reward[~newest.ended].any()
    else:
        assert reward.std() > 0


def test_what_terminated_is_told_from_what_ran_out_of_time():
    """The last two episodes end: the first of them is out of time, the second terminated."""
    chosen, given = ppo("dense"), steps_of(0)
    given.terminated[-1] = True
    learner = common.store(common.init(jax.random.key(0), chosen), given, chosen)
    taken = on_policy.rollout(learner, chosen)
    assert taken.ended[:, 0].sum() == 2
    np.testing.assert_array_equal(taken.continues[:, 0], [1.0] * 19 + [0.0])
    after = np.where(given.ended[:, None], given.next_observation, np.roll(given.observation, -1, axis=0))
    np.testing.assert_allclose(taken.next_observation[:, 0], after[-20:], rtol=1e-5)


def test_annealing_goes_by_what_is_left(monkeypatch):
    chosen, left = ppo("dense", steps=100), []

    def update(algorithm, rollout, key, share, settings):
        left.append(float(share))
        return algorithm, {}

    monkeypatch.setattr(on_policy.ppo, "update", update)
    for done in (0, 20, 80):
        on_policy.improve(stored(chosen), jax.random.key(0), jnp.array(done), chosen)
    assert left == pytest.approx([1.0, 0.8, 0.2])


def test_observations_are_normalised_by_what_was_known_when_acting():
    chosen = ppo("dense")
    learner, given = stored(chosen), steps_of(0)
    assert float(learner.observations.seen) == 0
    learner, _ = jax.jit(partial(on_policy.improve, recipe=chosen))(learner, jax.random.key(0), jnp.array(0))
    np.testing.assert_allclose(learner.observations.mean, given.observation[-20:].mean(axis=0), rtol=1e-3, atol=1e-5)
    before = learner.observations
    learner = common.store(learner, jax.tree.map(lambda leaf: leaf[:20] + leaf[:20], given), chosen)
    np.testing.assert_array_equal(learner.observations.mean, before.mean)
    taken = on_policy.rollout(learner, chosen)
    np.testing.assert_allclose(
        taken.observation[:, 0], standardise(before, jnp.asarray(2 * given.observation[:20])), rtol=1e-4, atol=1e-5
    )


def test_an_episode_that_goes_on_has_not_ended():
    chosen = ppo("dense")
    given = steps_of(0)
    cut = jax.tree.map(lambda leaf: leaf[:-3], given)
    learner = common.store(common.init(jax.random.key(0), chosen), cut, chosen)
    taken = on_policy.rollout(learner, chosen)
    np.testing.assert_array_equal(taken.ended[:, 0], cut.ended[-20:])
    assert not taken.ended[-1, 0]


@pytest.mark.parametrize("discrete", [False, True])
def test_acting(discrete):
    chosen = ppo("dense", discrete=discrete)
    actor, random = on_policy.actor_of(stored(chosen)), [np.random.default_rng(seed) for seed in (0, 1)]
    noise = on_policy.noise(random, chosen)
    assert noise.shape == (20, 2, 2)
    observation = jnp.ones(3)
    drawn = np.array([on_policy.explore(actor, observation, jnp.asarray(row)) for row in noise[:, 0]])
    if discrete:
        np.testing.assert_array_equal(np.sort(drawn, axis=1), np.broadcast_to([0, 1], drawn.shape))
        assert 0 < drawn[:, 0].sum() < len(drawn)
    else:
        np.testing.assert_allclose(drawn - on_policy.act(actor, observation), noise[:, 0], rtol=1e-4, atol=1e-5)


def test_seeds_in_lockstep_are_seeds_alone():
    chosen = ppo("lare-rrdu")
    functions = on_policy.compiled(chosen)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    start = jax.vmap(partial(common.init, recipe=chosen))(keys)
    many = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (3, *leaf.shape)), steps_of(2))
    together, _ = functions.improve(functions.store(start, many), keys, 40)
    alone = jax.jit(partial(common.store, recipe=chosen))(common.init(keys[1], chosen), steps_of(2))
    alone, _ = jax.jit(partial(on_policy.improve, recipe=chosen))(alone, keys[1], jnp.array(40))
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-3, atol=1e-4)
