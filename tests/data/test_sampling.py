import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.replays import COLUMNS, filled_replay, slow_replay, stream
from lare_rl.data import replay, sampling

LONGEST, CHUNKS, CAPACITY = 12, [20] * 4, 52
ROWS = [stream(np.roll((5, 12, 3, 9, 12) * 3, env), env)[:80] for env in range(3)]
FIRST, TRANSITIONS = {}, []
"""The length and the mean rewards of each finished episode, by its environment and first transition; all stored transitions."""
for env, env_rows in enumerate(ROWS):
    finished, running = slow_replay(env_rows, CHUNKS, CAPACITY)
    start = 80 - len(running) - sum(map(len, finished))
    TRANSITIONS += [(env, number) for number in range(start, 80)]
    for steps in finished:
        FIRST[env, start] = len(steps), np.mean([step[2] for step in steps], axis=0)
        start += len(steps)

ITEMS = sampling.sample_transitions, sampling.sample_episodes, sampling.sample_distinct_episodes
CREDIT = sampling.sample_packed, sampling.sample_episode_steps, sampling.sample_padded
sample_transitions, sample_episodes, sample_distinct_episodes = (jax.jit(item, static_argnums=2) for item in ITEMS)
sample_packed, sample_episode_steps, sample_padded = (jax.jit(item, static_argnums=(2, 3, 4)) for item in CREDIT)
episodes_in_order = jax.jit(sampling.episodes_in_order, static_argnums=(3, 4))


@pytest.fixture(scope="module")
def buffer():
    return filled_replay(ROWS, CHUNKS, CAPACITY)


def pairs(index):
    return list(zip(np.ravel(index.env).tolist(), np.ravel(index.number).tolist(), strict=True))


def assert_uniform(sampled, expected, deviations=6):
    distinct, counts = np.unique(sampled, axis=0, return_counts=True)
    assert sorted(map(tuple, distinct.tolist())) == sorted(expected)
    mean = len(sampled) / len(expected)
    np.testing.assert_allclose(counts, mean, atol=deviations * np.sqrt(mean))


def test_samples_are_uniform(buffer):
    assert_uniform(pairs(sample_transitions(buffer, jax.random.key(0), (200, 500))), TRANSITIONS)
    episodes = jax.tree.map(np.asarray, sample_episodes(buffer, jax.random.key(0), (30_000,)))
    firsts = pairs(episodes.first)
    assert_uniform(firsts, FIRST)
    assert episodes.mask.all()
    length, mean_reward = (np.array([FIRST[first][i] for first in firsts]) for i in range(2))
    np.testing.assert_array_equal(episodes.length, length)
    np.testing.assert_allclose(episodes.mean_reward, mean_reward, rtol=1e-5)


@pytest.mark.parametrize("count", [6, 200])
def test_sample_distinct_episodes(buffer, count):
    sample = jax.jit(jax.vmap(lambda key: sampling.sample_distinct_episodes(buffer, key, count)))
    episodes = jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(0), 200)))
    sampled = []
    for i, mask in enumerate(episodes.mask > 0):
        firsts = pairs(jax.tree.map(lambda leaf, i=i, mask=mask: leaf[i, mask], episodes.first))
        assert len(firsts) == len(set(firsts)) == min(count, len(FIRST))
        sampled += firsts
    assert_uniform(sampled, FIRST)


def test_samples_of_an_empty_replay_are_masked():
    empty, key = replay.init_replay(COLUMNS, 3, CAPACITY, 2), jax.random.key(0)
    np.testing.assert_array_equal(sample_transitions(empty, key, (3,)).number, 0)
    np.testing.assert_array_equal(sample_episodes(empty, key, (3,)).mask, 0)
    np.testing.assert_array_equal(sample_distinct_episodes(empty, key, 3).mask, 0)
    np.testing.assert_array_equal(sample_packed(empty, key, 2, 60, 60).episodes.mask, 0)


def assert_packed(sample, expected):
    """The rows are the steps of the expected episodes, and padding after them."""
    assert pairs(sample.episodes.first)[: len(expected)] == expected
    assert sample.episodes.mask.tolist() == [1] * len(expected) + [0] * (len(sample.episodes.mask) - len(expected))
    rows = [(env, first + t) for env, first in expected for t in range(FIRST[env, first][0])]
    slots = [slot for slot, first in enumerate(expected) for _ in range(FIRST[first][0])]
    assert pairs(sample.steps)[: len(rows)] == rows
    assert set(pairs(sample.steps)) <= set(TRANSITIONS)
    padding = len(sample.episode_index) - len(rows)
    assert sample.episode_index.tolist() == slots + [len(sample.episodes.mask)] * padding


@pytest.mark.parametrize(("steps", "rows"), [(60, 60), (5, LONGEST)])
def test_sample_packed(buffer, steps, rows):
    """As many episodes as their mean length says, unless they do not fit; at least one."""
    samples = jax.tree.map(np.asarray, sample_packed(buffer, jax.random.key(0), 24, steps, rows))
    requested = max(1, steps * len(FIRST) // sum(length for length, _ in FIRST.values()))
    counts = []
    for i in range(24):
        sample = jax.tree.map(lambda leaf, i=i: leaf[i], samples)
        assert len(sample.episode_index) == rows
        firsts = pairs(sample.episodes.first)[:requested]
        n_fits = int((np.cumsum([FIRST[first][0] for first in firsts]) <= rows).sum())
        assert_packed(sample, firsts[:n_fits])
        counts.append(n_fits)
    assert max(counts) == requested
    assert len({tuple(first) for first in samples.episodes.first.number.tolist()}) == 24


def test_sample_packed_of_many_steps(buffer):
    """The number of steps times the number of episodes may exceed 32 bits."""
    n_episodes, n_steps, steps = len(FIRST), sum(length for length, _ in FIRST.values()), 2**28
    assert steps * n_episodes > 2**31
    sample = jax.eval_shape(lambda: sampling.sample_packed(buffer, jax.random.key(0), 1, steps, 8))
    assert sample.episodes.mask.shape == (1, steps)
    assert int(sampling.n_packed_episodes(buffer, steps)) == pytest.approx(steps * n_episodes / n_steps, rel=1e-5)
    assert int(sampling.n_packed_episodes(buffer, n_steps)) == n_episodes


def test_episodes_in_order(buffer):
    since = jnp.array([0, buffer.current_episode[1] - 2, 100])  # all that are stored, the newest two, and none
    stored = [[first for first in FIRST if first[0] == env] for env in (0, 1)]
    assert sampling.count_episodes_since(buffer, since).tolist() == [len(stored[0]), 2, 0]
    expected = stored[0] + stored[1][-2:]
    sample = episodes_in_order(buffer, since, jnp.array(1), 20, 100)
    assert_packed(jax.tree.map(np.asarray, sample), expected[1:])
    sample = episodes_in_order(buffer, since, jnp.array(0), 2, 100)
    assert_packed(jax.tree.map(np.asarray, sample), expected[:2])


def test_sample_steps_and_padded_episodes(buffer):
    sample = jax.tree.map(np.asarray, sample_episode_steps(buffer, jax.random.key(0), 7, 6, 4))
    lengths = [FIRST[first][0] for first in pairs(sample.episodes.first)]
    assert 3 in lengths
    rows = pairs(sample.steps)
    for i, ((env, first), length) in enumerate(zip(pairs(sample.episodes.first), lengths, strict=True)):
        sampled = rows[4 * i : 4 * i + 4]
        assert set(sampled) <= {(env, first + t) for t in range(length)}
        assert len(set(sampled)) == min(length, 4)
        # An episode of three steps has three rows; its fourth row is padding.
        slots = sample.episode_index.reshape(42, 4)[i]
        assert slots.tolist() == [i % 6] * min(length, 4) + [6] * (4 - min(length, 4))
    sample = sample_padded(buffer, jax.random.key(0), 5, 8, LONGEST)
    firsts = pairs(sample.episodes.first)
    expected = [(env, first + min(t, FIRST[env, first][0] - 1)) for env, first in firsts for t in range(LONGEST)]
    assert pairs(sample.steps) == expected
    np.testing.assert_array_equal(sample.episode_index, np.tile(np.repeat(np.arange(8), LONGEST), (5, 1)))
