"""The store: numbers of steps, episodes of several environments, and a ring buffer that overwrites the oldest steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.assigner.store import Store
from lare_rl.errors import LareError


class SlowStore:
    """A slow twin, which never forgets a step."""

    def __init__(self, capacity):
        self.capacity, self.steps, self.running, self.ended = capacity, 0, {}, []

    def add(self, env_id):
        self.running.setdefault(env_id, []).append(self.steps)
        self.steps += 1

    def abandon_idle(self):
        """Abandon environments whose last step is not stored any more, and return their number."""
        idle = [env_id for env_id, steps in self.running.items() if steps[-1] < self.steps - self.capacity]
        for env_id in idle:
            del self.running[env_id]
        return len(idle)

    def stored_episodes(self):
        oldest = self.steps - self.capacity
        return sorted((tuple(steps), score) for steps, score in self.ended if steps[0] >= oldest)


MOVES = st.lists(st.tuples(st.sampled_from(["add", "add", "add", "end", "drop"]), st.integers(0, 2)), max_size=60)


@settings(max_examples=200, deadline=None)
@given(MOVES, st.integers(5, 12))
def test_store_matches_slow_twin(moves, capacity):
    store, twin, dropped = Store(capacity, (1,)), SlowStore(capacity), 0
    for move, env_id in moves:
        if move == "add":
            dropped += twin.abandon_idle()
        running = twin.running.get(env_id)
        if move == "add":
            (number,) = store.add(1)
            store.get_running(env_id, np.zeros(1, np.float32)).steps.append(int(number))
            twin.add(env_id)
        elif move == "drop":
            store.drop(env_id)
            dropped += twin.running.pop(env_id, None) is not None
        elif running is not None and running[0] < twin.steps - capacity:
            with pytest.raises(LareError, match="capacity larger"):
                store.end(env_id, 1.0)
            twin.running.pop(env_id)
        elif running is not None:
            store.end(env_id, float(len(twin.ended)))
            twin.ended.append((twin.running.pop(env_id), float(len(twin.ended))))
        assert sorted((tuple(e.steps.tolist()), e.score) for e in store.episodes.values()) == twin.stored_episodes()
        assert {env_id: episode.steps for env_id, episode in store.running.items()} == twin.running
        assert (store.steps, store.ended, store.dropped) == (twin.steps, len(twin.ended), dropped)
        assert store.ended_steps == sum(len(steps) for steps, _ in twin.ended)
        assert sorted(number for _, number in store.oldest) == sorted(store.episodes)
    for steps, score in twin.stored_episodes():
        rows = store.rows(np.array(steps))
        assert store.length[rows].tolist() == [len(steps)] * len(steps)
        np.testing.assert_allclose(store.mean_reward[rows], score / len(steps), rtol=1e-6)


def test_get_running_begins_an_episode_after_an_unseen_reset():
    store = Store(10, (1,))
    episode = store.get_running("env", np.zeros(1, np.float32))
    episode.steps += store.add(1).tolist()
    episode.last_observation = np.ones(1, np.float32)
    assert store.get_running("env", np.ones(1, np.float32)) is episode
    other = store.get_running("env", np.zeros(1, np.float32))
    assert other is not episode
    assert store.running == {"env": other}
    assert store.dropped == 1


def test_rows_refuses_steps_that_are_not_stored():
    store = Store(5, (1,))
    with pytest.raises(LareError, match="step 0 is not stored: no step is"):
        store.rows(np.array([0]))
    for _ in range(8):
        store.add(1)
    for steps, missing in [([8], 8), ([7, 2], 2), ([-1], -1)]:
        with pytest.raises(LareError, match=f"step {missing} .* 3 to 7 .*capacity = 5"):
            store.rows(np.array(steps))
    assert store.rows(np.array([7, 3])).tolist() == [2, 3]
    assert store.rows(np.zeros(0, np.int64)).tolist() == []


def test_lengths_of_a_running_episode_is_the_mean():
    store = Store(20, (1,))
    assert store.mean_length == 1
    for length in (3, 6):
        store.get_running(0, np.zeros(1, np.float32)).steps += store.add(length).tolist()
        store.end(0, 1.0)
    store.add(1)
    assert store.lengths(np.arange(10)).tolist() == [3] * 3 + [6] * 6 + [4]


def test_running_episodes_that_never_end_are_dropped():
    store = Store(10, (1,))
    for env_id in range(1000):
        store.get_running(env_id, np.zeros(1, np.float32)).steps.append(int(store.add(1)[0]))
        assert len(store.running) <= 12
    assert store.dropped >= 988


def test_add_refuses_more_steps_than_the_capacity():
    store = Store(10, (1,))
    with pytest.raises(LareError, match=r"11 .*capacity = 10"):
        store.add(11)
    assert store.steps == 0
