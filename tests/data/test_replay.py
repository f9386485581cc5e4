"""The replay against plain lists of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.data import replay
from lare_rl.data.replay import Index

ENVS, LONGEST, CHUNKS = 3, 6, (1, 3, 7)
CAPACITY = replay.required_capacity(max(CHUNKS), LONGEST)
COLUMNS = {
    "observation": jax.ShapeDtypeStruct((2, 1), np.float32),
    "state": jax.ShapeDtypeStruct((3,), np.float32),
    "action": jax.ShapeDtypeStruct((2, 1), np.float32),
    "terminated": jax.ShapeDtypeStruct((), np.bool_),
}
extend, read = jax.jit(replay.extend), jax.jit(replay.read)


def stream(lengths, env=0):
    """Return steps of episodes, the last of which is running: (observation, next observation, team rewards, ended).

    Every observation is a different number, so that each row can be recognised.
    """
    rows = []
    for episode, length in enumerate(lengths):
        for step in range(length):
            observation = 100_000 * env + 20 * episode + step
            ended = step == length - 1 and episode < len(lengths) - 1
            rows.append((observation, observation + 1, np.float32([episode + 0.5, -step]), ended))
    return rows


def replay_columns(rows_by_env):
    """Return some steps of each environment as the replay stores them."""
    observation, next_observation, reward, ended = (
        np.array([[row[k] for row in rows] for rows in rows_by_env]).swapaxes(0, 1) for k in range(4)
    )

    def columns(number):
        values = number[..., None].astype(np.float32)
        return {"observation": np.stack([values, -values], axis=2), "state": values * np.float32([1, 2, 3])}

    before = columns(observation)
    before |= {"action": 7 + before["observation"], "terminated": ended & (observation % 2 == 0)}
    return before, columns(next_observation), reward, ended


def filled_replay(rows_by_env, chunks, capacity=CAPACITY):
    buffer, start = replay.init_replay(COLUMNS, len(rows_by_env), capacity, 2), 0
    for count in chunks:
        buffer = extend(buffer, *replay_columns([rows[start : start + count] for rows in rows_by_env]))
        start += count
    return buffer


def slow_replay(rows, chunks, capacity=CAPACITY):
    """Return the finished episodes and the running one that a replay stores: before each chunk, remove the oldest until it fits."""
    episodes, running, start = [], [], 0
    for count in chunks:
        n_removable = len(episodes)
        for row in rows[start : start + count]:
            running.append(row)
            if row[3]:
                episodes.append(running)
                running = []
        start += count
        while n_removable and sum(len(e) + 1 for e in episodes) + (len(running) + 1 if running else 0) > capacity:
            episodes.pop(0)
            n_removable -= 1
    return episodes, running


LENGTHS = st.lists(st.integers(1, LONGEST), min_size=1, max_size=8)


@given(st.lists(LENGTHS, min_size=ENVS, max_size=ENVS), st.lists(st.sampled_from(CHUNKS), min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_replay_matches_slow_twin(lengths_by_env, chunks):
    total = sum(chunks)
    rows = [stream(lengths * (total + 1), env)[:total] for env, lengths in enumerate(lengths_by_env)]
    buffer = filled_replay(rows, chunks)
    number = np.asarray(replay.oldest_transition(buffer))[:, None] + np.arange(CAPACITY)
    steps = read(buffer, Index(jnp.repeat(jnp.arange(ENVS)[:, None], CAPACITY, axis=1), jnp.asarray(number)))
    n_transitions, n_finished = np.asarray(replay.n_transitions(buffer)), np.asarray(replay.n_finished(buffer))
    for env in range(ENVS):
        episodes, running = slow_replay(rows[env], chunks)
        assert n_finished[env] == len(episodes)
        assert n_transitions[env] == sum(map(len, episodes)) + len(running)
        i = 0
        for is_finished, episode in [*((True, episode) for episode in episodes), (False, running)]:
            return_ = np.sum([step[2] for step in episode], axis=0) if episode else None
            for t, (observation, next_observation, _, ended) in enumerate(episode):
                at, is_last = (env, i), t == len(episode) - 1
                columns, next_columns, *_ = replay_columns([[(observation, next_observation, [0, 0], ended)]])
                for name in COLUMNS:
                    np.testing.assert_array_equal(steps.columns[name][at], columns[name][0, 0])
                for name in ("observation", "state"):
                    np.testing.assert_array_equal(steps.next_columns[name][at], next_columns[name][0, 0])
                assert bool(steps.finished[at]) == is_finished
                np.testing.assert_allclose(steps.mean_reward[at], return_ / len(episode), rtol=1e-6)
                np.testing.assert_allclose(steps.episodic_reward[at], return_ * (is_finished and is_last), rtol=1e-6)
                i += 1
    assert set(steps.next_columns) == {"observation", "state"}


def test_extend_in_chunks():
    rows = [stream([4, 6, 3, 2, 5], env) for env in range(ENVS)]
    chunked, at_once = filled_replay(rows, [3, 7, 1, 7, 1, 1], capacity=60), filled_replay(rows, [20], capacity=60)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, chunked, at_once))


def test_columns_are_those_of_init():
    steps, few = replay_columns([stream([3, 4], env) for env in range(2)]), {"observation": COLUMNS["observation"]}
    before, after = ({"observation": columns["observation"]} for columns in steps[:2])
    buffer = replay.extend(replay.init_replay(few, 2, CAPACITY, 2), before, after, *steps[2:])
    newest = replay.read(buffer, replay.newest_steps(buffer, 2))
    assert (set(newest.columns), set(newest.next_columns)) == ({"observation"}, {"observation"})


def test_newest_steps():
    rows = [stream([4, 6, 3, 2, 5], env) for env in range(ENVS)]
    buffer = filled_replay(rows, [7, 7])
    observation = read(buffer, replay.newest_steps(buffer, 5)).columns["observation"]
    np.testing.assert_array_equal(observation[..., 0, 0], [[row[0] for row in env[9:14]] for env in rows])


def test_abandon_running():
    buffer = filled_replay([stream([2, 5], 0), stream([4, 3], 1), stream([3, 1, 9], 2)], [7])
    assert buffer.running.tolist() == [True, True, True]
    abandoned = replay.abandon_running(buffer, jnp.array([True, False, True]))
    assert replay.n_transitions(abandoned).tolist() == [2, 7, 4]
    assert abandoned.next_row.tolist() == [3, int(buffer.next_row[1]), 6]
    assert abandoned.running.tolist() == [False, True, False]
    longer = extend(abandoned, *replay_columns([stream([7], env)[:3] for env in (7, 8, 9)]))
    steps = read(longer, replay.newest_steps(longer, 3))
    np.testing.assert_array_equal(
        steps.columns["observation"][..., 0, 0], [[k, k + 1, k + 2] for k in (700_000, 800_000, 900_000)]
    )
    np.testing.assert_allclose(steps.mean_reward[0], [[0.5, -1]] * 3)
    unchanged = replay.abandon_running(abandoned, jnp.array([True, False, True]))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, unchanged, abandoned))


def test_hide_newest():
    buffer = filled_replay([stream([2, 3, 1, 1])], [7])
    hidden = replay.hide_newest(buffer, jnp.array([2]))
    assert replay.n_finished(hidden).tolist() == [1]
    number = jnp.arange(7)
    assert read(hidden, Index(0 * number, number)).finished.tolist() == [True] * 2 + [False] * 5
    restored = hidden._replace(episodes=buffer.episodes, running=buffer.running)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, restored, buffer))


@pytest.mark.parametrize(("steps", "longest"), [(1, 1), (7, 6), (50, 1000)])
def test_required_capacity(steps, longest):
    # The worst case: a running episode lacks one step of the longest, and then each step is an episode.
    worst = stream([longest, *[1] * (steps - 1), 1])
    rows = longest + 1 + 2 * (steps - 1) if steps > 1 else longest + 1
    assert len(worst) == longest + steps
    assert rows <= replay.required_capacity(steps, longest)


def test_empty_replay():
    empty = replay.init_replay(COLUMNS, ENVS, CAPACITY, 2)
    assert replay.n_transitions(empty).tolist() == replay.n_finished(empty).tolist() == [0, 0, 0]
