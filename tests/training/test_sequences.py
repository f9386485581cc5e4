"""Whole episodes out of the replay, and the updates of QMIX on them."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.recipes import (
    LENGTHS,
    TOGETHER,
    TOTAL,
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
from helpers.tiers import long
from lare_rl.data import replay
from lare_rl.data.sampling import episodes_at, sample_distinct_episodes
from lare_rl.nn.normalise import standardise
from lare_rl.training import learner as common
from lare_rl.training import sequences
from lare_rl.training.compiled import compiled

qmix = partial(config_of, algorithm="qmix", env=TOGETHER, environments=2)


def of_seed(learner, place=0):
    return jax.tree.map(lambda leaf: leaf[place], learner)


def one_seed(leaves):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], leaves)


def sequences_of(learner, drawn, steps, config):
    def of(learner, drawn):
        return sequences.sequences(learner.replay, drawn, steps, paid_by(learner), learner.algorithm.states, config)

    return jax.jit(of)(learner, drawn)


def episodes_of(steps):
    """By environment, the numbers of the steps of each episode."""
    ends = [np.flatnonzero(steps.ended[:, env]) + 1 for env in range(2)]
    return [[np.arange(a, b) for a, b in zip([0, *of_env], of_env, strict=False)] for of_env in ends]


@pytest.mark.parametrize("method", ["lare-rd", long("episodic")])
def test_episodes_against_the_steps_that_were_stored(method):
    config, steps = qmix(method), steps_of(TOGETHER, 2)
    learner = stored(config)
    drawn = jax.jit(sample_distinct_episodes, static_argnums=2)(learner.replay, jax.random.key(0), 12)
    batch = sequences_of(learner, drawn, 12, config)
    assert np.asarray(drawn.mask).tolist() == [1] * 10 + [0, 0]
    whole = episodes_of(steps)
    before, after = steps.before, steps.after
    for place in range(12):
        if place >= 10:
            assert not any(part[place].any() for part in (batch.mask, batch.reward, batch.terminated))
            continue
        env, first = int(drawn.first.env[place]), int(drawn.first.number[place])
        rows = next(rows for rows in whole[env] if rows[0] == first)
        last, length = rows[-1], len(rows)
        np.testing.assert_array_equal(batch.mask[place], np.arange(12) < length)
        np.testing.assert_array_equal(batch.terminated[place], np.arange(12) == length - 1)
        for name in ("observation", "state", "available"):
            got, given = getattr(batch, name)[place], [getattr(part, name)[:, env] for part in (before, after)]
            np.testing.assert_array_equal(got[:length], given[0][rows])
            if name == "available":  # what is left to do at the end nobody asks
                assert np.asarray(got[length:]).any(axis=-1).all()
            else:
                np.testing.assert_array_equal(got[length:], np.broadcast_to(given[1][last], got[length:].shape))
        np.testing.assert_array_equal(batch.action[place, :length], steps.action[rows, env])
        number = np.concatenate([rows, np.full(12 - length, last)])
        index = replay.Index(np.full(12, env), number)
        paid = np.asarray(jitted(common.rewards, config)(read(learner.replay, index), paid_by(learner)))[:length]
        alive = before.alive[rows, env]
        want = (paid * alive).sum(axis=1) / np.maximum(alive.sum(axis=1), 1)
        np.testing.assert_allclose(batch.reward[place, :length], want, rtol=1e-4, atol=1e-6)
        assert not batch.reward[place, length:].any()


def test_the_mixer_is_given_the_state_by_its_mean_and_deviation_or_all_observations():
    config, steps = qmix("dense"), steps_of(TOGETHER, 2)
    learner = stored(config)
    states = sequences.with_states(learner.algorithm.states, jax.tree.map(jnp.asarray, steps), config)
    rows = steps.after.state.reshape(-1, 5)
    np.testing.assert_allclose(states.mean, rows.mean(axis=0), rtol=1e-3, atol=1e-5)
    drawn = episodes_at(learner.replay, replay.Index(jnp.zeros(1, int), jnp.zeros(1, int)))
    batch = sequences_of(learner._replace(algorithm=learner.algorithm._replace(states=states)), drawn, 5, config)
    want = standardise(states, jnp.asarray(steps.before.state[:5, 0]))
    np.testing.assert_allclose(batch.state[0, :5], want, rtol=1e-4, atol=1e-5)

    nobody = qmix("dense", env=replace(TOGETHER, state_size=0))
    assert sequences.mixer_input_size(nobody) == 9
    shown = {"observation": jnp.arange(18.0).reshape(2, 3, 3)}
    np.testing.assert_array_equal(sequences.mixer_input(shown, nobody), jnp.arange(18.0).reshape(2, 9))
    assert "state" not in nobody.columns


def test_targets_move_when_enough_episodes_have_been_played():
    """One update for 2 episodes, targets every 4: at every second update."""
    config = qmix("dense")
    learner = stored(config)
    drawn = sample_distinct_episodes(learner.replay, jax.random.key(0), 4)
    update = jax.jit(partial(sequences.one_update, config=config, steps=12))
    moved = []
    for number in (1, 2, 3, 4):
        (made, _), _ = update(learner, drawn, jax.random.key(0), jnp.array(number))
        moved.append(jax.tree.all(jax.tree.map(jnp.array_equal, made.target, made.online)))
    assert moved == [False, True, False, True]


def improved(config, learner, steps, key=0):
    improve = jax.jit(partial(sequences.improve, config=config))
    return improve(one_seed(learner), one_seed(steps), jax.random.key(key)[None], jnp.array(0))


@pytest.mark.parametrize("method", [long("dense"), long("lare-rrdu"), "lare-rd"])
def test_as_many_updates_as_episodes_are_worth(method):
    config, steps = qmix(method), steps_of(TOGETHER, 2)
    learner = stored(config)
    after, measured = improved(config, learner, steps)
    assert measured["algorithm/updates"].tolist() == [5]
    assert after.algorithm.done.tolist() == [5]
    assert ("credit/loss" in measured) == config.interleaved == (method != "dense")
    assert all(np.isfinite(values).all() for values in measured.values())
    again, measured = improved(config, of_seed(after), steps)
    assert measured["algorithm/updates"].tolist() == [0]
    for a, b in zip(jax.tree.leaves(again.algorithm.qmix), jax.tree.leaves(after.algorithm.qmix), strict=True):
        np.testing.assert_array_equal(a, b)


def test_nothing_is_learned_before_there_are_episodes_for_a_batch():
    """They were worth an update each, which is not made up for."""
    config = qmix("dense")
    few = jax.tree.map(lambda rows: rows[:12], steps_of(TOGETHER, 2))
    learner = with_steps(untrained(config), config, few)
    assert int(few.ended.sum()) == 2
    after, measured = improved(config, learner, few)
    assert (measured["algorithm/updates"].tolist(), after.algorithm.done.tolist()) == ([0], [1])
    assert np.isnan(measured["critic/loss"]).all()
    rest = jax.tree.map(lambda rows: rows[12:], steps_of(TOGETHER, 2))
    after, measured = improved(config, with_steps(of_seed(after), config, rest), rest)
    assert (measured["algorithm/updates"].tolist(), after.algorithm.done.tolist()) == ([4], [5])


@pytest.mark.long
def test_how_long_a_batch_is_cut_changes_nothing(monkeypatch):
    config, steps = qmix("lare-rd"), steps_of(TOGETHER, 2, lengths=(5, 3, 2, 6, 4))
    learner = with_steps(untrained(config), config, steps)
    assert sequences.lengths(config) == [12]
    other, again = improved(config, learner, steps)
    monkeypatch.setattr(sequences, "WORTH_CUTTING", 0)
    assert sequences.lengths(config) == [3, 6, 12]
    one, measured = improved(config, learner, steps)
    assert float(measured["algorithm/updates"][0]) == 5
    for a, b in zip(jax.tree.leaves((one, measured)), jax.tree.leaves((other, again)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_seeds_in_lockstep_are_seeds_alone():
    """Also where they have had a different number of updates, and batches of different length."""
    config = qmix("lare-rrdu", rollout_steps=TOTAL)
    functions, keys = compiled(config), jax.vmap(jax.random.key)(jnp.arange(2))
    start = functions.init(keys)
    of_each = [steps_of(TOGETHER, 2, seed) for seed in (0, 1)]
    goes_on = of_each[1].after.truncated.copy()
    goes_on[np.cumsum(LENGTHS)[0] - 1, 0] = goes_on[TOTAL - 1] = False
    of_each[1] = of_each[1]._replace(after=of_each[1].after._replace(truncated=goes_on))
    factors = [factors_for(config, steps) for steps in of_each]
    both, all_factors = (jax.tree.map(lambda *leaves: np.stack(leaves), *part) for part in (of_each, factors))
    alone = [jax.tree.map(lambda leaf, seed=seed: np.asarray(leaf)[seed], start) for seed in (0, 1)]
    started = functions.learn_returns(store_seeds(config)(start, both, all_factors))
    together, measured = functions.improve(started, both, keys, 0)
    assert measured["algorithm/updates"].tolist() == [5, 3]
    improve = jax.jit(partial(sequences.improve, config=config))
    for seed in (0, 1):
        learner = one_seed(with_steps(alone[seed], config, of_each[seed], factors[seed], tell=True))
        found, _ = improve(learner, one_seed(of_each[seed]), keys[seed][None], jnp.array(0))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(np.asarray(a)[seed], np.asarray(b)[0], rtol=1e-3, atol=1e-5)
