"""The ring of trajectories against a plain list of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare.training import replay
from lare.training.replay import Step

CAPACITY = 23


def steps_of(lengths, unfinished=0):
    """Steps of episodes whose observation says episode and place, so that every row can be recognised."""
    rows = []
    for episode, length in enumerate([*lengths, unfinished]):
        for place in range(length):
            last = place == length - 1 and episode < len(lengths)
            terminated = last and episode % 2 == 0
            rows.append((episode, place, terminated, last))
    episode, place, terminated, ended = (np.array(column) for column in zip(*rows, strict=True))
    return Step(
        observation=np.stack([episode, place], 1).astype(np.float32),
        action=place[:, None].astype(np.float32),
        factors=(10.0 * place)[:, None].astype(np.float32),
        reward=(episode + 0.5).astype(np.float32),
        next_observation=np.stack([episode, place + 1], 1).astype(np.float32),
        terminated=terminated.astype(bool),
        ended=ended.astype(bool),
    )


def filled(lengths, unfinished=0, capacity=CAPACITY):
    return jax.jit(replay.extend)(replay.empty(capacity, 2, 1, 1), steps_of(lengths, unfinished))


def kept(lengths, unfinished, capacity):
    """Which episodes a ring of that capacity still holds, the slow way: drop the oldest until the rest fits."""
    episodes = [(number, length) for number, length in enumerate(lengths)]
    while sum(length + 1 for _, length in episodes) + (unfinished + 1 if unfinished else 0) > capacity:
        episodes.pop(0)
    return episodes


lists_of_lengths = st.lists(st.integers(1, 9), min_size=1, max_size=12)


@given(lists_of_lengths, st.integers(0, 9))
@settings(max_examples=20, deadline=None)
def test_holds_the_newest_episodes_whole(lengths, unfinished):
    held = filled(lengths, unfinished)
    oldest, size = int(replay.oldest_transition(held)), int(replay.size(held))
    drawn = replay.read(held, oldest + jnp.arange(size))
    episodes = kept(lengths, unfinished, CAPACITY)
    # The ring may let go of one episode sooner than a perfect one would (it keeps a row for the next observation).
    stored = sorted({int(episode) for episode in np.asarray(drawn.observation)[:, 0]})
    want = [number for number, _ in episodes] + ([len(lengths)] if unfinished else [])
    assert stored == want
    expected = steps_of(lengths, unfinished)
    chosen = np.isin(np.asarray(expected.observation)[:, 0], stored)
    np.testing.assert_array_equal(drawn.observation, expected.observation[chosen])
    np.testing.assert_array_equal(drawn.next_observation, expected.next_observation[chosen])
    np.testing.assert_array_equal(drawn.action, expected.action[chosen])
    np.testing.assert_array_equal(drawn.factors, expected.factors[chosen])
    np.testing.assert_array_equal(drawn.reward, expected.reward[chosen])
    np.testing.assert_array_equal(drawn.continues, 1.0 - expected.terminated[chosen])
    ends = np.asarray(expected.ended)[chosen]
    returns = np.array([lengths[int(e)] * (e + 0.5) if int(e) < len(lengths) else 0 for e in drawn.observation[:, 0]])
    np.testing.assert_array_equal(drawn.episodic_reward, np.where(ends, returns, 0))


@given(lists_of_lengths, st.integers(0, 9), st.integers(0, 100))
@settings(max_examples=10, deadline=None)
def test_episodes_are_drawn_whole_and_finished(lengths, unfinished, seed):
    held = filled(lengths, unfinished)
    drawn = replay.draw_episodes(held, jax.random.key(seed), (16,))
    finished = {number for number, _ in kept(lengths, unfinished, CAPACITY)}
    if not finished:
        assert not np.asarray(drawn.counts).any()
        return
    first = replay.read(held, drawn.first)
    episode = np.asarray(first.observation)[:, 0].astype(int)
    assert set(episode) <= finished
    assert np.asarray(drawn.counts).all()
    np.testing.assert_array_equal(first.observation[:, 1], 0)
    np.testing.assert_array_equal(drawn.length, np.array(lengths)[episode])
    np.testing.assert_allclose(drawn.mean_reward, episode + 0.5, rtol=1e-6)


def test_adding_in_pieces_is_adding_at_once():
    lengths, pieces = [4, 7, 3, 9, 5], [3, 10, 1, 14]
    steps = steps_of(lengths)
    held, start = replay.empty(CAPACITY, 2, 1, 1), 0
    for piece in pieces:
        held = replay.extend(held, jax.tree.map(lambda leaf, a=start, b=start + piece: leaf[a:b], steps))
        start += piece
    assert start == sum(lengths)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, held, filled(lengths)))


def test_dropping_the_running_episode_forgets_it_and_nothing_else():
    held = replay.drop_running(filled([4, 5], unfinished=3))
    whole = filled([4, 5])
    assert int(replay.size(held)) == int(replay.size(whole)) == 9
    assert int(held.next_row) == int(whole.next_row)
    again = replay.extend(held, steps_of([6]))
    last = replay.read(again, again.transitions - 6 + jnp.arange(6))
    np.testing.assert_array_equal(last.observation[:, 1], np.arange(6))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, replay.drop_running(whole), whole))


def test_transitions_are_drawn_uniformly():
    held = filled([9, 1, 6], unfinished=4, capacity=40)
    numbers = replay.draw_transitions(held, jax.random.key(0), (40_000,))
    counts = np.bincount(np.asarray(numbers) - int(replay.oldest_transition(held)))
    assert len(counts) == 20
    np.testing.assert_allclose(counts / 2000, 1, atol=0.12)


def test_drawing_from_nothing_gives_something_that_counts_for_nothing():
    nothing = replay.empty(CAPACITY, 2, 1, 1)
    assert int(replay.size(nothing)) == 0
    np.testing.assert_array_equal(replay.draw_transitions(nothing, jax.random.key(0), (3,)), 0)
    np.testing.assert_array_equal(replay.draw_episodes(nothing, jax.random.key(0), (3,)).counts, 0)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.integers(1, 12), st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_steps_are_drawn_without_replacement_and_all_of_them_where_there_are_too_few(lengths, drawn, seed):
    steps = np.asarray(replay.draw_steps(jax.random.key(seed), jnp.asarray(lengths), drawn))
    assert steps.shape == (len(lengths), drawn)
    for length, row in zip(lengths, steps, strict=True):
        assert row.min() >= 0
        assert row.max() < length
        assert len(set(row)) == min(length, drawn)
        if length < drawn:
            np.testing.assert_array_equal(row, np.minimum(np.arange(drawn), length - 1))


@pytest.mark.parametrize(("length", "drawn"), [(6, 3), (6, 6)])
def test_every_step_is_drawn_equally_often(length, drawn):
    steps = replay.draw_steps(jax.random.key(1), jnp.full(20_000, length), drawn)
    share = np.bincount(np.asarray(steps).ravel(), minlength=length) / steps.size
    np.testing.assert_allclose(share, 1 / length, atol=0.01)


def test_every_pair_of_steps_is_drawn_equally_often():
    steps = np.sort(np.asarray(replay.draw_steps(jax.random.key(2), jnp.full(30_000, 5), 2)), axis=1)
    share = np.bincount(steps[:, 0] * 5 + steps[:, 1], minlength=25) / len(steps)
    np.testing.assert_allclose(share[share > 0], 0.1, atol=0.01)
    assert (share > 0).sum() == 10
