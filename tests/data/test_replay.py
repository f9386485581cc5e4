"""The rings of trajectories against plain lists of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.data import replay
from lare_rl.data.replay import Index

ENVS, LONGEST, CHUNKS = 3, 6, (1, 3, 7)
CAPACITY = replay.room(max(CHUNKS), LONGEST)
COLUMNS = {
    "observation": jax.ShapeDtypeStruct((2, 1), np.float32),
    "state": jax.ShapeDtypeStruct((3,), np.float32),
    "action": jax.ShapeDtypeStruct((2, 1), np.float32),
    "terminated": jax.ShapeDtypeStruct((), np.bool_),
}
extend, read = jax.jit(replay.extend), jax.jit(replay.read)


def stream(lengths, env=0):
    """Steps of episodes, the last of which goes on: a list of what stands before, after, what teams earned, and the end.

    Every observation is another number, so that each row can be recognised.
    """
    rows = []
    for episode, length in enumerate(lengths):
        for step in range(length):
            here = 100_000 * env + 20 * episode + step
            ended = step == length - 1 and episode < len(lengths) - 1
            rows.append((here, here + 1, np.float32([episode + 0.5, -step]), ended))
    return rows


def chunk(rows):
    """Some steps of each environment as the replay takes them."""
    here, led_to, reward, ended = (np.array([[row[k] for row in one] for one in rows]).swapaxes(0, 1) for k in range(4))

    def shown(number):
        many = number[..., None].astype(np.float32)
        return {"observation": np.stack([many, -many], axis=2), "state": many * np.float32([1, 2, 3])}

    before = shown(here) | {"action": 7 + shown(here)["observation"], "terminated": ended & (here % 2 == 0)}
    return before, shown(led_to), reward, ended


def stored(rows, chunks, capacity=CAPACITY):
    held, start = replay.empty(COLUMNS, len(rows), capacity, 2), 0
    for count in chunks:
        held = extend(held, *chunk([of_one[start : start + count] for of_one in rows]))
        start += count
    return held


def kept(rows, chunks, capacity=CAPACITY):
    """Which episodes the ring of one environment holds, the slow way: before each chunk, the oldest go until it fits."""
    episodes, running, start = [], [], 0
    for count in chunks:
        whole = len(episodes)
        for row in rows[start : start + count]:
            running.append(row)
            if row[3]:
                episodes.append(running)
                running = []
        start += count
        while whole and sum(len(one) + 1 for one in episodes) + (len(running) + 1 if running else 0) > capacity:
            episodes.pop(0)
            whole -= 1
    return episodes, running


lengths = st.lists(st.integers(1, LONGEST), min_size=1, max_size=8)


@given(st.lists(lengths, min_size=ENVS, max_size=ENVS), st.lists(st.sampled_from(CHUNKS), min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_whatever_comes_in_whatever_pieces_the_newest_episodes_are_held_whole(of_envs, chunks):
    total = sum(chunks)
    rows = [stream(one * (total + 1), env)[:total] for env, one in enumerate(of_envs)]
    held = stored(rows, chunks)
    number = np.asarray(replay.oldest_transition(held))[:, None] + np.arange(CAPACITY)
    found = read(held, Index(jnp.repeat(jnp.arange(ENVS)[:, None], CAPACITY, axis=1), jnp.asarray(number)))
    sizes, whole = np.asarray(replay.size(held)), np.asarray(replay.finished(held))
    for env in range(ENVS):
        episodes, running = kept(rows[env], chunks)
        assert whole[env] == len(episodes)
        assert sizes[env] == sum(map(len, episodes)) + len(running)
        place = 0
        for done, steps in [*((True, one) for one in episodes), (False, running)]:
            returned = np.sum([step[2] for step in steps], axis=0) if steps else None
            for number, (here, led_to, _, ended) in enumerate(steps):
                at, last = (env, place), number == len(steps) - 1
                want = chunk([[(here, led_to, [0, 0], ended)]])
                for name in COLUMNS:
                    np.testing.assert_array_equal(found.before[name][at], want[0][name][0, 0])
                for name in ("observation", "state"):
                    np.testing.assert_array_equal(found.after[name][at], want[1][name][0, 0])
                assert bool(found.finished[at]) == done
                np.testing.assert_allclose(found.mean_reward[at], returned / len(steps), rtol=1e-6)
                np.testing.assert_allclose(found.episodic_reward[at], returned * (done and last), rtol=1e-6)
                place += 1
    assert set(found.after) == {"observation", "state"}


def test_adding_in_pieces_is_adding_at_once():
    rows = [stream([4, 6, 3, 2, 5], env) for env in range(ENVS)]
    pieces, whole = stored(rows, [3, 7, 1, 7, 1, 1], capacity=60), stored(rows, [20], capacity=60)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, pieces, whole))


def test_a_column_that_nobody_reads_is_not_there():
    steps, few = chunk([stream([3, 4], env) for env in range(2)]), {"observation": COLUMNS["observation"]}
    before, after = ({"observation": part["observation"]} for part in steps[:2])
    held = replay.extend(replay.empty(few, 2, CAPACITY, 2), before, after, *steps[2:])
    found = replay.read(held, replay.newest(held, 2))
    assert (set(found.before), set(found.after)) == ({"observation"}, {"observation"})


def test_the_newest_steps_of_every_environment():
    rows = [stream([4, 6, 3, 2, 5], env) for env in range(ENVS)]
    held = stored(rows, [7, 7])
    found = read(held, replay.newest(held, 5)).before["observation"]
    np.testing.assert_array_equal(found[..., 0, 0], [[row[0] for row in of_one[9:14]] for of_one in rows])


def test_dropping_running_episodes_forgets_them_and_nothing_else():
    rows = [stream([2, 5], 0), stream([4, 3], 1), stream([3, 1, 9], 2)]
    held = stored(rows, [7])
    assert held.running.tolist() == [True, True, True]
    dropped = replay.drop_running(held, jnp.array([True, False, True]))
    assert replay.size(dropped).tolist() == [2, 7, 4]
    assert dropped.next_row.tolist() == [3, int(held.next_row[1]), 6]
    assert dropped.running.tolist() == [False, True, False]
    again = extend(dropped, *chunk([stream([7], env)[:3] for env in (7, 8, 9)]))
    found = read(again, replay.newest(again, 3))
    np.testing.assert_array_equal(
        found.before["observation"][..., 0, 0], [[k, k + 1, k + 2] for k in (700_000, 800_000, 900_000)]
    )
    np.testing.assert_allclose(found.mean_reward[0], [[0.5, -1]] * 3)
    unchanged = replay.drop_running(dropped, jnp.array([True, False, True]))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, unchanged, dropped))


@pytest.mark.parametrize(("steps", "longest"), [(1, 1), (7, 6), (50, 1000)])
def test_room_for_the_worst_case(steps, longest):
    """An episode under way that lacks one step of the longest, and then as many episodes of a single step as there are steps."""
    worst = stream([longest, *[1] * (steps - 1), 1])
    rows = longest + 1 + 2 * (steps - 1) if steps > 1 else longest + 1
    assert len(worst) == longest + steps
    assert rows <= replay.room(steps, longest)


def test_drawing_from_nothing():
    nothing = replay.empty(COLUMNS, ENVS, CAPACITY, 2)
    assert replay.size(nothing).tolist() == replay.finished(nothing).tolist() == [0, 0, 0]
