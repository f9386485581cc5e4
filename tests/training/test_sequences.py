"""The training step of algorithms that consume whole episodes."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from helpers.numpy_twins import assert_close, equal
from helpers.small_configs import (
    LENGTHS,
    ONE_TEAM,
    TOTAL,
    add_steps,
    jitted,
    learner_with_episodes,
    random_factors,
    random_steps,
    read,
    small_config,
    store_seeds,
    untrained_learner,
)
from lare_rl.data import replay
from lare_rl.data.sampling import get_episodes, sample_distinct_episodes
from lare_rl.nn.normalise import standardise
from lare_rl.training import sequences
from lare_rl.training.compiled import compile_functions
from lare_rl.training.rewards import rewards
from lare_rl.training.seed_axis import select_seed

qmix_config = partial(small_config, algorithm="qmix", env=ONE_TEAM, n_envs=2)


def add_seed_axis(leaves):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], leaves)


def compute_sequences(learner, episodes, n_steps, config):
    def compute(learner, episodes):
        statistics = learner.algorithm.mixer_statistics
        return sequences._sequences(learner.replay, episodes, n_steps, learner.decoders, statistics, config)

    return jax.jit(compute)(learner, episodes)


def episode_rows(steps, env):
    """Return the indices of the steps of each episode of an environment."""
    ends = np.flatnonzero(steps.ended[:, env]) + 1
    return [np.arange(a, b) for a, b in zip([0, *ends], ends, strict=False)]


@pytest.mark.parametrize("method", [long_case("lare-rd"), "episodic"])
def test_sequences_are_the_stored_episodes(method):
    config, steps = qmix_config(method), random_steps(ONE_TEAM, 2)
    learner = learner_with_episodes(config)
    episodes = jax.jit(sample_distinct_episodes, static_argnums=2)(learner.replay, jax.random.key(0), 12)
    batch = compute_sequences(learner, episodes, 12, config)
    assert np.asarray(episodes.mask).tolist() == [1] * 10 + [0, 0]
    timestep, next_timestep = steps.timestep, steps.next_timestep
    assert not any(values[10:].any() for values in (batch.mask, batch.reward, batch.done))
    for i in range(10):
        env, first = int(episodes.first.env[i]), int(episodes.first.number[i])
        rows = next(rows for rows in episode_rows(steps, env) if rows[0] == first)
        last, length = rows[-1], len(rows)
        np.testing.assert_array_equal(batch.mask[i], np.arange(12) < length)
        np.testing.assert_array_equal(batch.done[i], np.arange(12) == length - 1)
        for name in ("observation", "state", "available"):
            values, final = getattr(batch, name)[i], getattr(next_timestep, name)[last, env]
            np.testing.assert_array_equal(values[:length], getattr(timestep, name)[rows, env])
            if name != "available":
                np.testing.assert_array_equal(values[length:], np.broadcast_to(final, values[length:].shape))
        assert np.asarray(batch.available[i, length:]).any(axis=-1).all()
        np.testing.assert_array_equal(batch.action[i, :length], steps.action[rows, env])
        index = replay.Index(np.full(12, env), np.concatenate([rows, np.full(12 - length, last)]))
        reward = np.asarray(jitted(rewards, config)(read(learner.replay, index), learner.decoders))[:length]
        alive = timestep.alive[rows, env]
        expected = (reward * alive).sum(axis=1) / np.maximum(alive.sum(axis=1), 1)
        np.testing.assert_allclose(batch.reward[i, :length], expected, rtol=1e-4, atol=1e-6)
        assert not batch.reward[i, length:].any()


def test_agents_that_left_can_only_choose_the_first_action():
    env = replace(ONE_TEAM, masks_actions=False)
    config = qmix_config("episodic", env=env)
    episodes = jax.jit(sample_distinct_episodes, static_argnums=2)
    learner = learner_with_episodes(config)
    sample = episodes(learner.replay, jax.random.key(0), 10)
    batch = compute_sequences(learner, sample, 12, config)
    steps, n_choices = random_steps(env, 2), np.asarray(batch.available).sum(axis=-1)
    for i in range(10):
        index, first = int(sample.first.env[i]), int(sample.first.number[i])
        rows = next(rows for rows in episode_rows(steps, index) if rows[0] == first)
        expected = np.where(steps.timestep.alive[rows, index], env.action_size, 1)
        np.testing.assert_array_equal(n_choices[i, : len(rows)], expected)
    assert np.asarray(batch.available)[..., 0].all()


def test_mixer_input_is_the_standardised_state_or_all_observations():
    config, steps = qmix_config("dense"), random_steps(ONE_TEAM, 2)
    learner = learner_with_episodes(config)
    new_steps = jax.tree.map(jnp.asarray, steps)
    statistics = sequences._observe_states(learner.algorithm.mixer_statistics, new_steps, config)
    mean = steps.next_timestep.state.reshape(-1, 5).mean(axis=0)
    np.testing.assert_allclose(statistics.mean, mean, rtol=1e-3, atol=1e-5)
    episodes = get_episodes(learner.replay, replay.Index(jnp.zeros(1, int), jnp.zeros(1, int)))
    learner = learner._replace(algorithm=learner.algorithm._replace(mixer_statistics=statistics))
    batch = compute_sequences(learner, episodes, 5, config)
    expected = standardise(statistics, jnp.asarray(steps.timestep.state[:5, 0]))
    np.testing.assert_allclose(batch.state[0, :5], expected, rtol=1e-4, atol=1e-5)

    stateless = qmix_config("dense", env=replace(ONE_TEAM, state_size=0))
    assert untrained_learner(stateless).algorithm.mixer_statistics.mean.shape == (9,)
    observation = jnp.arange(18.0).reshape(2, 3, 3)
    mixer_input = sequences._mixer_input(observation, jnp.zeros((2, 0)), stateless)
    np.testing.assert_array_equal(mixer_input, observation.reshape(2, 9))
    assert "state" not in stateless.columns


def test_targets_are_copied_after_enough_episodes():
    config = qmix_config("dense")  # an update for 2 episodes, and a copy after 4
    learner = learner_with_episodes(config)
    episodes = sample_distinct_episodes(learner.replay, jax.random.key(0), 4)
    update = jax.jit(partial(sequences._update_seed, config=config, n_steps=12))
    is_copied = []
    for number in (1, 2, 3, 4):
        (state, _), _ = update(learner, episodes, jax.random.key(0), jnp.array(number))
        is_copied.append(jax.tree.all(jax.tree.map(jnp.array_equal, state.target, state.online)))
    assert is_copied == [False, True, False, True]


def train_step(config, learner, steps, train=None):
    train = train or jitted(sequences.train_step, config)
    return train(add_seed_axis(learner), add_seed_axis(steps), jax.random.key(0)[None], jnp.array(0))


@pytest.mark.long
@pytest.mark.parametrize("method", ["dense", "lare-rd", "lare-rrdu"])
def test_train_step_updates_once_for_enough_episodes(method):
    config, steps = qmix_config(method), random_steps(ONE_TEAM, 2)
    updated, metrics = train_step(config, learner_with_episodes(config), steps)
    assert metrics["algorithm/updates"].tolist() == updated.algorithm.n_due.tolist() == [5]
    assert ("credit/loss" in metrics) == config.joint_fit == (method != "dense")
    assert all(np.isfinite(values).all() for values in metrics.values())
    unchanged, metrics = train_step(config, select_seed(updated), steps)
    assert metrics["algorithm/updates"].tolist() == [0]
    assert equal(unchanged.algorithm.networks, updated.algorithm.networks)


@pytest.mark.long
def test_train_step_waits_for_a_batch_of_episodes():
    config = qmix_config("dense")
    few = jax.tree.map(lambda rows: rows[:12], random_steps(ONE_TEAM, 2))
    learner = add_steps(untrained_learner(config), config, few)
    assert int(few.ended.sum()) == 2
    learner, metrics = train_step(config, learner, few)
    assert (metrics["algorithm/updates"].tolist(), learner.algorithm.n_due.tolist()) == ([0], [1])
    assert np.isnan(metrics["critic/loss"]).all()
    rest = jax.tree.map(lambda rows: rows[12:], random_steps(ONE_TEAM, 2))
    learner, metrics = train_step(config, add_steps(select_seed(learner), config, rest), rest)
    assert (metrics["algorithm/updates"].tolist(), learner.algorithm.n_due.tolist()) == ([4], [5])


@pytest.mark.long
def test_batch_lengths_change_nothing(monkeypatch):
    config, steps = qmix_config("lare-rd"), random_steps(ONE_TEAM, 2, lengths=(5, 3, 2, 6, 4))
    learner = add_steps(untrained_learner(config), config, steps)
    assert sequences._batch_lengths(config) == [12]
    results = [train_step(config, learner, steps)]
    monkeypatch.setattr(sequences, "MIN_STEPS_TO_SHORTEN", 0)
    assert sequences._batch_lengths(config) == [3, 6, 12]
    results.append(train_step(config, learner, steps, jax.jit(partial(sequences.train_step, config=config))))
    assert float(results[1][1]["algorithm/updates"][0]) == 5
    assert_close(*results, 1e-3)


@pytest.mark.long
def test_train_step_of_seeds_in_lockstep():
    # The seeds have different numbers of updates, and batches of different lengths.
    config = qmix_config("lare-rrdu", rollout_steps=TOTAL)
    functions, keys = compile_functions(config), jax.vmap(jax.random.key)(jnp.arange(2))
    start = functions.init(keys)
    steps = [random_steps(ONE_TEAM, 2, seed) for seed in (0, 1)]
    truncated = steps[1].next_timestep.truncated.copy()
    truncated[np.cumsum(LENGTHS)[0] - 1, 0] = truncated[TOTAL - 1] = False
    steps[1] = steps[1]._replace(next_timestep=steps[1].next_timestep._replace(truncated=truncated))
    factors = [random_factors(config, trajectory) for trajectory in steps]
    stacked = [jax.tree.map(lambda *leaves: np.stack(leaves), *values) for values in (steps, factors)]
    alone = [jax.tree.map(lambda leaf, seed=seed: np.asarray(leaf)[seed], start) for seed in (0, 1)]
    together = functions.learn_returns(store_seeds(config)(start, *stacked))
    together, metrics = functions.train_step(together, stacked[0], keys, 0)
    assert metrics["algorithm/updates"].tolist() == [5, 3]
    train = jax.jit(partial(sequences.train_step, config=config))
    for seed in (0, 1):
        learner = add_seed_axis(add_steps(alone[seed], config, steps[seed], factors[seed], learn=True))
        single, _ = train(learner, add_seed_axis(steps[seed]), keys[seed][None], jnp.array(0))
        assert_close(select_seed(together, seed), select_seed(single), 1e-3)
