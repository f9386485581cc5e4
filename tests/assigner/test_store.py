"""The store: numbers of steps, episodes of several environments, and a ring buffer that overwrites the oldest steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.assigner.store import MAX_MISMATCHES, Store
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PaymentRule

MOVES = st.lists(st.tuples(st.sampled_from(["add", "add", "add", "end", "drop"]), st.integers(0, 2)), max_size=60)
NOT_ENDED = np.zeros(1, bool), np.zeros(1, int)
"""`ended` and `level` of one step."""


@settings(max_examples=100, deadline=None)
@given(MOVES, st.integers(5, 12))
def test_store_matches_a_twin_that_stores_all_steps(moves, capacity):
    """An episode that goes on after all its steps were overwritten stays abandoned: its last steps are no whole episode."""
    store, n_steps, running, ended, dropped, abandoned = Store(capacity, (1,)), 0, {}, [], 0, set()
    for move, env_id in moves:
        steps = running.get(env_id)
        if move == "add":
            idle = [name for name, numbers in running.items() if numbers[-1] < n_steps - capacity]
            running = {name: numbers for name, numbers in running.items() if name not in idle}
            dropped += len(set(idle) - abandoned)
            abandoned |= set(idle)
            (number,) = store.add(1)
            store.get_running(env_id, np.zeros(1, np.float32)).step_ids.append(int(number))
            running.setdefault(env_id, []).append(n_steps)
            n_steps += 1
        elif move == "drop":
            store.drop(env_id)
            dropped += running.pop(env_id, None) is not None and env_id not in abandoned
            abandoned.discard(env_id)
        elif steps is not None and env_id in abandoned:
            with pytest.raises(LareError, match="was abandoned"):
                store.end(env_id, 1.0)
            del running[env_id]
            abandoned.discard(env_id)
        elif steps is not None and steps[0] < n_steps - capacity:
            with pytest.raises(LareError, match="capacity larger"):
                store.end(env_id, 1.0)
            del running[env_id]
            dropped += 1
        elif steps is not None:
            store.end(env_id, float(len(ended)))
            ended.append((tuple(running.pop(env_id)), float(len(ended))))
        stored = sorted((steps, score) for steps, score in ended if steps[0] >= n_steps - capacity)
        assert sorted((tuple(e.step_ids.tolist()), e.return_) for e in store.episodes.values()) == stored
        assert {name: list(episode.step_ids) for name, episode in store.running.items()} == running
        assert (store.n_added, store.n_ended, store.dropped) == (n_steps, len(ended), dropped)
        assert store.n_ended_steps == sum(len(steps) for steps, _ in ended)
        assert sorted(number for _, number in store.oldest) == sorted(store.episodes)
        for steps, score in stored:
            rows = store.rows(np.array(steps))
            assert store.length[rows].tolist() == [len(steps)] * len(steps)
            np.testing.assert_allclose(store.mean_reward[rows], score / len(steps), rtol=1e-6)


def test_lengths_of_a_running_episode_is_the_mean():
    store = Store(20, (3,))
    assert store.bytes_per_step == 36
    assert store.mean_length == 1
    for length in (3, 6):
        step_ids = store.add(length).tolist()
        store.get_running(0, np.zeros(1, np.float32)).step_ids.extend(step_ids)
        store.end(0, 1.0)
    store.add(1)
    assert store.lengths(np.arange(10)).tolist() == [3] * 3 + [6] * 6 + [4]


def test_steps_that_never_continue_their_episode_are_warned_of():
    store, row = Store(50, (1,)), np.zeros((1, 1), np.float32)
    for i in range(MAX_MISMATCHES):  # every other step continues
        list(store.extend(["a"], store.add(1), [row + i // 2, row, row + (i + 1) // 2], np.zeros(1), *NOT_ENDED))

    def add_noisy_steps():
        for _ in range(MAX_MISMATCHES + 1):
            list(store.extend(["b"], store.add(1), [row, row, row + 1e-6], np.zeros(1), *NOT_ENDED))

    with pytest.warns(RuntimeWarning, match="another observation than the next_observation"):
        add_noisy_steps()


def test_lengths_of_a_long_running_episode_is_its_steps_since_the_last_payment():
    store, row = Store(9, (1,), payments=PaymentRule(nonzero=True)), [np.zeros((1, 1), np.float32)] * 3
    for i in range(12):
        env_id = "b" if i in {5, 11} else "a"
        list(store.extend([env_id], store.add(1), row, np.array([float(i == 1)]), *NOT_ENDED))
    assert store.mean_length == 2
    assert store.lengths(store.rows(np.arange(3, 12))).tolist() == [8, 8, 2, 8, 8, 8, 8, 8, 2]
    store.drop("a")
    assert store.lengths(store.rows(np.arange(3, 12))).tolist() == [2] * 9


def test_lengths_with_a_window_are_the_steps_that_payments_are_for():
    """T is the number of steps that a payment is for, also at steps that no payment has followed yet."""
    store, row = Store(20, (1,), payments=PaymentRule(period=2, window=5)), np.zeros((11, 1), np.float32)
    payments = list(
        store.extend(["a"] * 11, store.add(11), [row] * 3, np.ones(11), np.zeros(11, bool), np.zeros(11, int))
    )
    assert [len(payment.step_ids) for payment in payments] == [2, 4, 5, 5, 5]
    assert store.lengths(np.arange(11)).tolist() == [2, 2, 4, 4, *[5] * 7]
    assert store.mean_length == 21 // 5


@pytest.mark.parametrize(
    ("rule", "steps", "scores"),
    [
        (PaymentRule(period=2), [[0, 1], [2, 3], [4]], [3, 7, 5]),
        (PaymentRule(nonzero=True), [[0], [1], [2], [3], [4]], [1, 2, 3, 4, 5]),
        (PaymentRule(period=3, window=2), [[1, 2], [3, 4]], [6, 9]),
        (PaymentRule(period=3, window=4), [[0, 1, 2], [1, 2, 3, 4]], [6, 9]),
    ],
    ids=str,
)
def test_payments_are_stored_as_episodes(rule, steps, scores):
    reward, rows = np.arange(1.0, 6), np.zeros((5, 1), np.float32)
    step_by_step, at_once = Store(9, (1,), payments=rule), Store(9, (1,), payments=rule)
    numbers = step_by_step.add(5)
    stored = list(step_by_step.extend(["a"] * 5, numbers, [rows] * 3, reward, np.arange(5) == 4, np.zeros(5, int)))
    assert [episode.step_ids.tolist() for episode in stored] == steps
    assert [episode.return_ for episode in stored] == scores
    assert not step_by_step.running
    assert [episode.return_ for episode in at_once.add_paid_episode(at_once.add(5), reward, rule)] == scores
    np.testing.assert_array_equal(step_by_step.mean_reward, at_once.mean_reward)
    assert step_by_step.length[4] == len(steps[-1])


def test_extend_raises_the_first_refusal():
    """The other episodes of the call are stored."""
    store, rows = Store(9, (1,), longest=1), [np.zeros((6, 1), np.float32)] * 3
    ended, level = np.array([0, 0, 1, 0, 1, 1], bool), np.zeros(6, int)
    with pytest.raises(LareError, match="this one is for 2:"):
        list(store.extend("abbaac", store.add(6), rows, np.ones(6), ended, level))
    assert (store.n_ended, store.dropped, store.running) == (1, 2, {})
    store = Store(9, (1,), longest=3)
    with pytest.raises(LareError, match="this one is for 4:"):
        list(store.add_paid_episode(store.add(5), np.array([0.0, 0, 0, 1, 1]), PaymentRule(nonzero=True)))
    assert (store.n_ended, store.dropped) == (1, 1)


def test_late_payment_leaves_steps_of_other_environments():
    """A payment for the last steps comes when most steps since the last payment are not stored any more."""
    store, row = Store(10, (1,), payments=PaymentRule(nonzero=True, window=3)), [np.zeros((1, 1), np.float32)] * 3
    for i in range(21):
        env_id, reward = "b" if 9 <= i < 12 else "a", {11: 200.0, 20: 9.0}.get(i, 0.0)
        list(store.extend([env_id], store.add(1), row, np.array([reward]), *NOT_ENDED))
    rows = store.rows(np.arange(11, 21))
    assert store.episode[rows].tolist() == [0] + 9 * [1]
    np.testing.assert_allclose(store.mean_reward[rows], [200 / 3] + 9 * [3], rtol=1e-6)


def test_end_needs_steps_that_are_not_paid():
    store, rows = Store(9, (1,), payments=PaymentRule(period=2)), np.zeros((2, 1), np.float32)
    list(store.extend(["a"] * 2, store.add(2), [rows] * 3, np.ones(2), np.zeros(2, bool), np.zeros(2, int)))
    with pytest.raises(LareError, match="'a' was paid already"):
        store.end("a", 1.0)
