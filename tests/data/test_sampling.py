"""Which stored steps an update reads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import (
    LENGTHS,
    add_steps,
    learner_with_episodes,
    random_steps,
    small_config,
    untrained_learner,
)
from lare_rl.data import replay, sampling
from lare_rl.envs.interface import EnvSpec, Team

ENVS = 3
ENV = EnvSpec(
    (Team("agent", 0, 1),), 3, 2, False, 12, low=-np.ones((1, 2), np.float32), high=np.ones((1, 2), np.float32)
)
CONFIG = small_config("rd", env=ENV, n_envs=ENVS)

sample_transitions, sample_episodes, sample_distinct_episodes = (
    jax.jit(function, static_argnums=2)
    for function in (sampling.sample_transitions, sampling.sample_episodes, sampling.sample_distinct_episodes)
)
sample_packed, sample_drawn, sample_padded = (
    jax.jit(function, static_argnums=(2, 3, 4))
    for function in (sampling.sample_packed, sampling.sample_drawn, sampling.sample_padded)
)


@pytest.fixture(scope="module")
def buffer():
    """A replay whose environments have different numbers of steps and episodes: 41, 50, 46 and 5, 6, 6."""
    learner = add_steps(learner_with_episodes(CONFIG), CONFIG, random_steps(ENV, ENVS, lengths=(5, 4)))
    return learner.replay._replace(
        transitions=learner.replay.transitions - jnp.array([9, 0, 4]),
        episodes=learner.replay.episodes - jnp.array([2, 1, 1]),
        running=jnp.array([False, True, False]),
    )


def test_sample_transitions_is_uniform(buffer):
    index = sample_transitions(buffer, jax.random.key(0), (200, 500))
    counts = np.asarray(replay.n_transitions(buffer))
    assert counts.tolist() == [41, 50, 46]
    starts, oldest = np.cumsum(counts) - counts, np.asarray(replay.oldest_transition(buffer))
    env = np.asarray(index.env)
    position = starts[env] + np.asarray(index.number) - oldest[env]
    share = np.bincount(position.ravel(), minlength=counts.sum()) / 100_000 * counts.sum()
    assert len(share) == counts.sum()
    np.testing.assert_allclose(share, 1, atol=0.18)  # six standard deviations


def test_sample_episodes_is_uniform(buffer):
    episodes = sample_episodes(buffer, jax.random.key(0), (30_000,))
    assert replay.n_finished(buffer).tolist() == [5, 6, 6]
    distinct, counts = np.unique(np.stack(episodes.first, axis=1), axis=0, return_counts=True)
    assert len(distinct) == 17
    np.testing.assert_allclose(counts / 30_000 * 17, 1, atol=0.15)
    assert np.asarray(episodes.mask).all()


def test_sample_episodes_returns_finished_episodes(buffer):
    episodes = jax.tree.map(np.asarray, sample_episodes(buffer, jax.random.key(0), (50,)))
    t = np.arange(max(LENGTHS))
    assert episodes.length.max() == len(t)
    env, number = np.broadcast_arrays(episodes.first.env[:, None], episodes.first.number[:, None] + t)
    steps = jax.tree.map(np.asarray, jax.jit(replay.read)(buffer, replay.Index(jnp.asarray(env), jnp.asarray(number))))
    for row, (length, mean) in enumerate(zip(episodes.length, episodes.mean_reward, strict=True)):
        episode = jax.tree.map(lambda leaf, row=row, length=length: leaf[row, :length], steps)
        assert episode.finished.all()
        assert not episode.episodic_reward[:-1].any()
        assert float(mean[0]) == pytest.approx(float(episode.columns["reward"].mean()), rel=1e-4)
        assert float(episode.episodic_reward[-1, 0]) == pytest.approx(float(mean[0] * length), rel=1e-4)


@pytest.mark.parametrize("count", [1, 6, 17, 40])
def test_sample_distinct_episodes(buffer, count):
    sample = jax.jit(lambda key: sample_distinct_episodes(buffer, key, count))
    stored = {
        tuple(first) for first in np.stack(sample_episodes(buffer, jax.random.key(0), (999,)).first, axis=1).tolist()
    }
    frequency = dict.fromkeys(stored, 0)
    for seed in range(60):
        episodes = sample(jax.random.key(seed))
        mask = np.asarray(episodes.mask) > 0
        assert mask.sum() == min(count, 17)
        firsts = [tuple(first) for first in np.stack(episodes.first, axis=1)[mask].tolist()]
        assert len(set(firsts)) == len(firsts)
        for first in firsts:
            frequency[first] += 1
    assert len(frequency) == 17
    if count == 6:
        np.testing.assert_allclose(list(frequency.values()), 60 * 6 / 17, atol=6 * np.sqrt(60 * 6 / 17))


def test_samples_of_an_empty_replay_are_masked():
    empty, key = untrained_learner(CONFIG).replay, jax.random.key(0)
    np.testing.assert_array_equal(sample_transitions(empty, key, (3,)).number, 0)
    np.testing.assert_array_equal(sample_episodes(empty, key, (3,)).mask, 0)
    np.testing.assert_array_equal(sample_distinct_episodes(empty, key, 3).mask, 0)
    np.testing.assert_array_equal(sample_packed(empty, key, 2, 24, 12).episodes.mask, 0)


@pytest.mark.parametrize("key", range(4))
@pytest.mark.parametrize("envs", [1, 3])
def test_sample_packed_has_whole_episodes(key, envs):
    learner = learner_with_episodes(small_config("rd", env=ENV, n_envs=envs))
    sample = sample_packed(learner.replay, jax.random.key(key), 1, 24, 12)
    sample = jax.tree.map(lambda leaf: np.asarray(leaf[0]), sample)
    length, mask = sample.episodes.length, sample.episodes.mask
    # 24 steps with a mean length of 8.2 are two episodes, if they fit.
    assert 1 <= mask.sum() <= 2
    assert length[mask > 0].sum() <= 24
    for i in np.flatnonzero(mask):
        rows = sample.steps.number[sample.episode == i]
        np.testing.assert_array_equal(rows, sample.episodes.first.number[i] + np.arange(length[i]))
        assert set(sample.steps.env[sample.episode == i]) == {sample.episodes.first.env[i]}
    assert set(sample.episode) <= {*np.flatnonzero(mask), 24}


def test_sample_packed_has_about_the_number_of_steps():
    samples = sample_packed(learner_with_episodes(CONFIG).replay, jax.random.key(0), 8, 60, 12)
    counts = []
    for length, mask in zip(np.asarray(samples.episodes.length), np.asarray(samples.episodes.mask), strict=True):
        fits = np.cumsum(length)[:7] <= 60  # 60 steps with a mean length of 8.2 are seven episodes
        np.testing.assert_array_equal(mask, [*fits, *[0] * (60 - 7)])
        counts.append(mask.sum())
    assert max(counts) == 7


@pytest.mark.parametrize("envs", [1, 3])
def test_sample_drawn_has_steps_of_its_episodes(envs):
    buffer = learner_with_episodes(small_config("rrdu", env=ENV, n_envs=envs)).replay
    sample = sample_drawn(buffer, jax.random.key(0), 7, 6, 4)
    episodes = sample.episodes
    first, length, env = (
        np.repeat(np.asarray(values), 4, axis=1)
        for values in (episodes.first.number, episodes.length, episodes.first.env)
    )
    number = np.asarray(sample.steps.number)
    assert number.shape == (7, 24)
    assert ((number >= first) & (number < first + length)).all()
    np.testing.assert_array_equal(sample.steps.env, env)
    # An episode of three steps has three rows; its fourth row is padding.
    is_step = np.asarray(sample.episode).reshape(7, 6, 4) < 6
    np.testing.assert_array_equal(is_step.sum(axis=2), np.minimum(episodes.length, 4))
    assert (np.asarray(episodes.length) == 3).any()


def test_sample_padded_repeats_the_last_step():
    sample = sample_padded(learner_with_episodes(CONFIG).replay, jax.random.key(0), 5, 8, 12)
    steps = np.asarray(sample.steps.number).reshape(5 * 8, 12)
    first, length = (np.asarray(x).ravel() for x in (sample.episodes.first.number, sample.episodes.length))
    for row, start, count in zip(steps, first, length, strict=True):
        np.testing.assert_array_equal(row, start + np.minimum(np.arange(12), count - 1))
    assert set(length) == set(LENGTHS)
    np.testing.assert_array_equal(sample.episode, np.tile(np.repeat(np.arange(8), 12), (5, 1)))
