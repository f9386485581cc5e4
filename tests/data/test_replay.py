import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.replays import COLUMNS, extend, filled_replay, read, replay_columns, slow_replay, slow_segments, stream
from lare_rl.data import replay, sampling
from lare_rl.data.extend import abandon_running
from lare_rl.data.replay import Index
from lare_rl.tasks.payments import PaymentRule

ENVS, LONGEST, CHUNKS = 3, 6, (1, 3, 7)
CAPACITY = replay.required_capacity(max(CHUNKS), LONGEST)
LENGTHS = st.lists(st.integers(1, LONGEST), min_size=1, max_size=8)


def read_all(buffer):
    """Read the stored steps of each environment, [envs rows ...], and others after them."""
    number = np.asarray(replay.oldest_transition(buffer))[:, None] + np.arange(CAPACITY)
    steps = read(buffer, Index(np.repeat(np.arange(ENVS)[:, None], CAPACITY, axis=1), number))
    return jax.tree.map(np.asarray, steps)


@given(st.lists(LENGTHS, min_size=ENVS, max_size=ENVS), st.lists(st.sampled_from(CHUNKS), min_size=1, max_size=8))
@settings(max_examples=25, deadline=None)
def test_replay_matches_slow_twin(lengths_by_env, chunks):
    total = sum(chunks)
    rows = [stream(lengths * (total + 1), env)[:total] for env, lengths in enumerate(lengths_by_env)]
    buffer = filled_replay(rows, chunks, CAPACITY)
    steps = read_all(buffer)
    # The number of the last step that ended an episode is the number of steps of finished episodes.
    ends = [[i + 1 for i, row in enumerate(env_rows) if row[3]] for env_rows in rows]
    mean_length = sum(env_ends[-1] for env_ends in ends if env_ends) // max(1, sum(map(len, ends)))
    assert replay.mean_length(buffer) == max(1, mean_length)
    for env in range(ENVS):
        finished, running = slow_replay(rows[env], chunks, CAPACITY)
        episodes = [*finished, running] if running else finished
        stored = [step for episode in episodes for step in episode]
        assert int(replay.n_stored_episodes(buffer)[env]) == len(finished)
        assert int(replay.n_stored_transitions(buffer)[env]) == len(stored)
        at = env, slice(len(stored))
        columns, next_columns, *_ = replay_columns([stored])
        for name in COLUMNS:
            np.testing.assert_array_equal(steps.columns[name][at], columns[name][:, 0])
        for name in ("observation", "state"):
            np.testing.assert_array_equal(steps.next_columns[name][at], next_columns[name][:, 0])
        lengths = [len(episode) for episode in episodes]
        length = np.repeat(lengths, lengths)
        return_ = np.repeat([np.sum([step[2] for step in episode], axis=0) for episode in episodes], lengths, axis=0)
        np.testing.assert_allclose(steps.mean_reward[at], return_ / length[:, None], rtol=1e-6)
        is_last = np.array([step[3] for step in stored])
        np.testing.assert_array_equal(steps.last[at], is_last)
        np.testing.assert_allclose(steps.episodic_reward[at], return_ * is_last[:, None], rtol=1e-6)
        is_finished = np.arange(len(stored)) < len(stored) - len(running)
        np.testing.assert_array_equal(steps.episode_ended[at], is_finished)
        expected_length = np.where(is_finished, length, np.maximum(length, mean_length))
        np.testing.assert_array_equal(steps.length[at], expected_length)
    assert set(steps.next_columns) == {"observation", "state"}


episodes_in_order = jax.jit(sampling.episodes_in_order, static_argnums=(3, 4))
MAX_STEPS = 8 * max(CHUNKS)
RULES = (
    PaymentRule(period=3),
    PaymentRule(period=4, nonzero=True),
    PaymentRule(period=4, window=2),
    PaymentRule(nonzero=True, window=3),
)


@pytest.mark.parametrize("rule", RULES, ids=str)
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_segments_match_slow_twin(rule, data):
    lengths_by_env = data.draw(st.lists(LENGTHS, min_size=ENVS, max_size=ENVS))
    chunks = data.draw(st.lists(st.sampled_from(CHUNKS[1:]), min_size=1, max_size=8))
    total, pays = sum(chunks), np.random.default_rng(data.draw(st.integers(0, 9))).random((ENVS, 200)) < 0.4
    rows = [stream(lengths * (total + 1), env)[:total] for env, lengths in enumerate(lengths_by_env)]
    rows = [[(*row[:2], row[2] * pays[env, i], row[3]) for i, row in enumerate(rows[env])] for env in range(ENVS)]
    buffer = filled_replay(rows, chunks, CAPACITY, rule)
    start, limits = jnp.zeros(ENVS, int), (ENVS * MAX_STEPS, ENVS * MAX_STEPS * LONGEST)
    sample = jax.tree.map(
        np.asarray, episodes_in_order(replay.segments_as_episodes(buffer), start, jnp.array(0), *limits)
    )
    observation = np.asarray(read(buffer, sample.steps).columns["observation"])[:, 0, 0]
    all_steps, expected = read_all(buffer), []
    for env in range(ENVS):
        finished, running = slow_replay(rows[env], chunks, CAPACITY)
        segments = slow_segments([*finished, running], rule)
        expected += segments
        n_stored = sum(map(len, [*finished, running]))
        steps = jax.tree.map(lambda rows, env=env, n=n_stored: rows[env, :n], all_steps)
        last = np.concatenate([np.arange(len(unpaid)) == len(unpaid) - 1 for _, unpaid, _ in segments] or [[]])
        np.testing.assert_array_equal(steps.last[: len(last)], last)
        np.testing.assert_array_equal(steps.episode_ended, np.arange(n_stored) < len(last))
        length = np.concatenate([np.full(len(unpaid), len(paid_for)) for _, unpaid, paid_for in segments] or [[]])
        np.testing.assert_array_equal(steps.length[: len(last)], length)
        payments = [payment for payment, _, _ in segments]
        np.testing.assert_allclose(steps.episodic_reward[steps.last], np.reshape(payments, (-1, 2)), rtol=1e-6)
        assert not steps.episodic_reward[~steps.last].any()
    assert int(np.sum(sample.episodes.mask)) == len(expected)
    for i, (payment, _, paid_for) in enumerate(expected):
        assert sample.episodes.length[i] == len(paid_for)
        np.testing.assert_allclose(sample.episodes.mean_reward[i] * len(paid_for), payment, rtol=1e-5)
        assert observation[sample.episode_index == i].tolist() == [step[0] for step in paid_for]


def test_abandon_running_and_its_payments():
    buffer = filled_replay([stream([2, 5])] * ENVS, [6], CAPACITY, PaymentRule(period=2))
    assert replay.segments_as_episodes(buffer).current_episode.tolist() == [3] * ENVS
    abandoned = abandon_running(buffer, jnp.array([True, False, True]))
    assert replay.segments_as_episodes(abandoned).current_episode.tolist() == [1, 3, 1]
    steps = replay_columns([stream([7], env)[:3] for env in (7, 8, 9)])
    longer = extend(abandoned, *steps, payments=PaymentRule(period=2))
    assert replay.segments_as_episodes(longer).current_episode.tolist() == [2, 4, 2]
    assert read(longer, replay.newest_steps(longer, 3)).last.tolist()[::2] == [[False, True, False]] * 2
    buffer = filled_replay([stream([2, 5], 0), stream([4, 3], 1), stream([3, 1, 9], 2)], [7], CAPACITY)
    assert buffer.running.tolist() == [True, True, True]
    abandoned = abandon_running(buffer, jnp.array([True, False, True]))
    assert replay.n_stored_transitions(abandoned).tolist() == [2, 7, 4]
    assert abandoned.next_row.tolist() == [3, int(buffer.next_row[1]), 6]
    assert abandoned.running.tolist() == [False, True, False]
    longer = extend(abandoned, *replay_columns([stream([7], env)[:3] for env in (7, 8, 9)]))
    steps = read(longer, replay.newest_steps(longer, 3))
    expected = [[k, k + 1, k + 2] for k in (700_000, 800_000, 900_000)]
    np.testing.assert_array_equal(steps.columns["observation"][..., 0, 0], expected)
    np.testing.assert_allclose(steps.mean_reward[0], [[0.5, -1]] * 3)
    unchanged = abandon_running(abandoned, jnp.array([True, False, True]))
    assert jax.tree.all(jax.tree.map(np.array_equal, unchanged, abandoned))


def test_hide_newest():
    buffer = filled_replay([stream([2, 3, 2, 1])[:7]] * ENVS, [7], CAPACITY)
    hidden = replay.hide_newest(buffer, jnp.array([2, 0, 1]))
    assert replay.n_stored_episodes(hidden).tolist() == [1, 3, 2]
    assert hidden.running.tolist() == [True, False, True]
    finished = read(hidden, replay.newest_steps(hidden, 7)).episode_ended
    assert finished.sum(axis=1).tolist() == [2, 7, 5]
    restored = hidden._replace(current_episode=buffer.current_episode, running=buffer.running)
    assert jax.tree.all(jax.tree.map(np.array_equal, restored, buffer))
