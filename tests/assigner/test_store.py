"""What an assigner has met: numbers of steps, lanes that come in between each other, and a ring that runs out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.assigner.store import Store
from lare_rl.errors import LareError


class Plain:
    """The same in the plainest way: every step is kept for ever."""

    def __init__(self, capacity):
        self.capacity, self.steps, self.running, self.ended = capacity, 0, {}, []

    def add(self, lane):
        self.running.setdefault(lane, []).append(self.steps)
        self.steps += 1

    def forget(self):
        """Lanes that have stood still for as many steps as are kept; how many they were."""
        still = [lane for lane, steps in self.running.items() if steps[-1] < self.steps - self.capacity]
        for lane in still:
            del self.running[lane]
        return len(still)

    def whole(self):
        oldest = self.steps - self.capacity
        return sorted((tuple(steps), score) for steps, score in self.ended if steps[0] >= oldest)


MOVES = st.lists(st.tuples(st.sampled_from(["add", "add", "add", "end", "drop"]), st.integers(0, 2)), max_size=60)


@settings(max_examples=200, deadline=None)
@given(MOVES, st.integers(5, 12))
def test_a_store_keeps_the_episodes_of_which_all_steps_are_there(moves, capacity):
    store, plain, dropped = Store(capacity, (1,)), Plain(capacity), 0
    for move, lane in moves:
        if move == "add":
            dropped += plain.forget()
        going = plain.running.get(lane)
        if move == "add":
            (number,) = store.add(1)
            store.running_of(lane, np.zeros(1, np.float32)).steps.append(int(number))
            plain.add(lane)
        elif move == "drop":
            store.drop(lane)
            dropped += plain.running.pop(lane, None) is not None
        elif going is not None and going[0] < plain.steps - capacity:
            with pytest.raises(LareError, match=f"capacity = {capacity} must be larger"):
                store.end(lane, 1.0)
            plain.running.pop(lane)
        elif going is not None:
            store.end(lane, float(len(plain.ended)))
            plain.ended.append((plain.running.pop(lane), float(len(plain.ended))))
        assert sorted((tuple(one.steps.tolist()), one.score) for one in store.episodes.values()) == plain.whole()
        assert {lane: run.steps for lane, run in store.running.items()} == plain.running
        assert (store.steps, store.ended, store.dropped) == (plain.steps, len(plain.ended), dropped)
        assert store.ended_steps == sum(len(steps) for steps, _ in plain.ended)
        assert sorted(number for _, number in store.oldest) == sorted(store.episodes)
    for steps, score in plain.whole():
        rows = store.rows(np.array(steps))
        assert store.length[rows].tolist() == [len(steps)] * len(steps)
        np.testing.assert_allclose(store.mean_reward[rows], score / len(steps), rtol=1e-6)


def test_a_step_that_sets_out_from_elsewhere_begins_an_episode():
    store = Store(10, (1,))
    run = store.running_of("lane", np.zeros(1, np.float32))
    run.steps += store.add(1).tolist()
    run.last = np.ones(1, np.float32)
    assert store.running_of("lane", np.ones(1, np.float32)) is run
    other = store.running_of("lane", np.zeros(1, np.float32))
    assert other is not run
    assert store.running == {"lane": other}
    assert store.dropped == 1


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([8], "step 8 is not stored, only 3 to 7 is (capacity = 5)"),
        ([7, 2], "step 2 is not stored, only 3 to 7 is (capacity = 5)"),
        ([-1], "step -1 is not stored, only 3 to 7 is (capacity = 5)"),
    ],
)
def test_steps_that_are_not_there_are_refused(steps, message):
    store = Store(5, (1,))
    for _ in range(8):
        store.add(1)
    with pytest.raises(LareError) as refused:
        store.rows(np.array(steps))
    assert str(refused.value) == message
    assert store.rows(np.array([7, 3])).tolist() == [2, 3]
    assert store.rows(np.zeros(0, np.int64)).tolist() == []


def test_an_empty_store_has_none():
    with pytest.raises(LareError, match=r"step 0 is not stored, nothing is \(capacity = 5\)"):
        Store(5, (1,)).rows(np.array([0]))


def test_the_length_of_an_episode_that_goes_on_is_that_of_the_others():
    store = Store(20, (1,))
    assert store.usual_length == 1
    for length in (3, 6):
        run = store.running_of(0, np.zeros(1, np.float32))
        run.steps += store.add(length).tolist()
        store.end(0, 1.0)
    store.add(1)
    assert store.lengths(np.arange(10)).tolist() == [3] * 3 + [6] * 6 + [4]


def test_lanes_that_never_end_do_not_pile_up():
    store = Store(10, (1,))
    for lane in range(1000):
        store.running_of(lane, np.zeros(1, np.float32)).steps.append(int(store.add(1)[0]))
        assert len(store.running) <= 12
    assert store.dropped >= 988


def test_more_steps_at_once_than_are_kept_are_refused():
    store = Store(10, (1,))
    with pytest.raises(LareError) as refused:
        store.add(11)
    assert str(refused.value) == "11 steps at once are more than the capacity of 10: make capacity larger"
    assert store.steps == 0
