"""Which steps an update of a decoder reads: whole episodes or parts of them, with what the episode returned."""

import numpy as np
import pytest

from lare_rl.assigner import draws
from lare_rl.assigner.store import Store
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import Fit

LENGTHS = (3, 7, 5, 1, 9)


def filled(capacity=100, agents=0):
    """A store in which the features of a step are its episode and its place; two lanes, by turns."""
    store = Store(capacity, (agents, 2) if agents else (2,))
    if agents:
        store.alive = np.ones((capacity, agents), bool)
    waiting = [[(number, place, length) for place in range(length)] for number, length in enumerate(LENGTHS)]
    lanes, turn = [[], []], 0
    while any(waiting) or any(lanes):
        lane, turn = lanes[turn], 1 - turn
        if not lane and waiting:
            lane += waiting.pop(0)
        if not lane:
            continue
        number, place, length = lane.pop(0)
        (step,) = store.add(1)
        store.features[step % capacity] = number, place
        store.running_of(number, np.zeros(1, np.float32)).steps.append(int(step))
        if agents:
            store.alive[step % capacity, 1:] = place < 2
        if place == length - 1:
            store.end(number, 10.0 * number)
    return store


def read(found):
    """What was drawn, episode by episode: (number, places, length, score)."""
    for place in np.flatnonzero(found.mask):
        rows = found.features[found.episode == place]
        rows = rows if rows.ndim == 2 else rows[:, 0]
        (number,) = set(rows[:, 0].tolist())
        yield int(number), rows[:, 1].astype(int).tolist(), found.length[place], found.mean_reward[place]


@pytest.mark.parametrize("seed", range(5))
def test_parts_are_drawn_without_replacement(seed):
    settings = CreditSettings(drawn_steps=4, steps=24)
    found = draws.batch(filled(), Fit.DRAWN_STEPS_UNBIASED, settings, np.random.default_rng(seed), 16)
    assert found.features.shape == (24, 2)
    assert len(list(read(found))) == 6
    for number, places, length, mean in read(found):
        assert length == LENGTHS[number]
        assert len(set(places)) == len(places) == min(4, length)
        assert mean == pytest.approx(10 * number / length)
    padding = found.episode == 6
    assert padding.sum() == 24 - sum(min(4, LENGTHS[number]) for number, *_ in read(found))


@pytest.mark.parametrize("seed", range(5))
def test_whole_episodes_are_packed_as_far_as_they_fit(seed):
    settings = CreditSettings(drawn_steps=4, steps=24)
    found = draws.batch(filled(), Fit.ALL_STEPS, settings, np.random.default_rng(seed), 16)
    assert found.features.shape == (24, 2)
    assert found.length.shape == (12,)
    for number, places, length, _ in read(found):
        assert places == list(range(LENGTHS[number]))
        assert length == LENGTHS[number]


def test_an_episode_that_is_longer_than_a_batch_makes_it_longer():
    settings = CreditSettings(drawn_steps=2, steps=4)
    store = filled()
    seen = set()
    for seed in range(60):
        found = draws.batch(store, Fit.ALL_STEPS, settings, np.random.default_rng(seed), 16)
        assert found.features.shape == (16, 2)
        seen |= {number for number, *_ in read(found)}
    assert seen == set(range(5))


def test_pieces_are_as_long_as_the_longest_can_be():
    settings = CreditSettings(episodes=3)
    found = draws.batch(filled(), Fit.SUBTRAJECTORIES, settings, np.random.default_rng(0), 16)
    assert found.features.shape == (48, 2)
    for number, places, length, _ in read(found):
        assert places == [*range(length), *[length - 1] * (16 - length)]
        assert length == LENGTHS[number]


def test_all_episodes_some_at_a_time():
    store = filled()
    found = list(draws.pieces(store, list(store.episodes.values()), 2, 10))
    assert [int(piece.mask.sum()) for piece in found] == [2, 2, 1]
    assert {piece.features.shape for piece in found} == {(10, 2)}
    everything = [one for piece in found for one in read(piece)]
    assert sorted(number for number, *_ in everything) == list(range(5))
    assert all(places == list(range(LENGTHS[number])) for number, places, *_ in everything)


def test_those_who_have_left_have_no_share():
    store = filled(agents=3)
    (found, *_) = draws.pieces(store, list(store.episodes.values())[:1], 2, 10)
    ((number, places, *_),) = read(found)
    want = [[1 / 3] * 3 if place < 2 else [1, 0, 0] for place in places]
    np.testing.assert_allclose(found.share[: LENGTHS[number]], want, rtol=1e-6)


def test_only_what_is_stored_is_drawn():
    store = filled(capacity=15)
    assert 0 < len(store.episodes) < 5
    for seed in range(10):
        found = draws.batch(store, Fit.ALL_STEPS, CreditSettings(steps=24), np.random.default_rng(seed), 16)
        assert {number for number, *_ in read(found)} <= set(store.episodes) | set(range(5))
        for number, places, *_ in read(found):
            assert places == list(range(LENGTHS[number]))
