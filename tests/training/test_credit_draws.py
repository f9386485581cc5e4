"""Which steps an update of the decoder reads."""

import jax
import numpy as np
import pytest

from lare.credit.decomposition import CreditSettings
from lare.training.credit_draws import draw_padded_episodes, draw_parts_of_episodes, draw_whole_episodes
from recipes import recipe, stored


@pytest.mark.parametrize("key", range(4))
def test_whole_episodes_are_masked_never_padded(key):
    chosen = recipe("rd")
    held = stored(chosen).replay
    drawn = draw_whole_episodes(held, jax.random.key(key), chosen)
    lengths, counts = np.asarray(drawn.episodes.length), np.asarray(drawn.episodes.counts)
    # About 24 steps: mean length 8.2, so two episodes, if they fit.
    assert 1 <= counts.sum() <= 2
    assert lengths[counts > 0].sum() <= 24
    for place in np.flatnonzero(counts):
        rows = np.asarray(drawn.steps)[np.asarray(drawn.episode) == place]
        np.testing.assert_array_equal(rows, int(drawn.episodes.first[place]) + np.arange(lengths[place]))
    assert set(np.asarray(drawn.episode)) <= {*np.flatnonzero(counts), chosen.credit.steps}


def test_as_many_whole_episodes_as_the_steps_are_on_average():
    """Mean length 8.2: 60 steps are 7 episodes, and the rows hold no more than 60."""
    chosen = recipe("rd", credit=CreditSettings(hidden=(8,), drawn_steps=4, steps=60))
    held, found = stored(chosen).replay, []
    for key in range(8):
        drawn = draw_whole_episodes(held, jax.random.key(key), chosen)
        lengths, counts = np.asarray(drawn.episodes.length), np.asarray(drawn.episodes.counts)
        fits = np.cumsum(lengths)[:7] <= 60
        np.testing.assert_array_equal(counts, [*fits, *[0] * (60 - 7)])
        found.append(counts.sum())
    assert max(found) == 7


def test_parts_of_episodes_stay_inside_them():
    chosen = recipe("rrdu")
    drawn = draw_parts_of_episodes(stored(chosen).replay, jax.random.key(0), 7, chosen)
    first = np.repeat(np.asarray(drawn.episodes.first), 4, axis=1)
    length = np.repeat(np.asarray(drawn.episodes.length), 4, axis=1)
    assert drawn.steps.shape == (7, 24)
    assert (np.asarray(drawn.steps) >= first).all()
    assert (np.asarray(drawn.steps) < first + length).all()
    # Of three steps, four cannot be drawn: all of them belong, and the fourth place holds none.
    belongs = np.asarray(drawn.episode).reshape(7, 6, 4) < 6
    np.testing.assert_array_equal(belongs.sum(axis=2), np.minimum(drawn.episodes.length, 4))
    assert (np.asarray(drawn.episodes.length) == 3).any()


def test_padded_episodes_are_whole_and_repeat_their_end():
    chosen = recipe("diaster")
    held = stored(chosen).replay
    drawn = draw_padded_episodes(held, jax.random.key(0), 5, chosen)
    steps = np.asarray(drawn.steps).reshape(5, chosen.credit.episodes, chosen.longest_episode)
    for of_update, first, length in zip(
        steps, np.asarray(drawn.episodes.first), np.asarray(drawn.episodes.length), strict=True
    ):
        for row, begin, count in zip(of_update, first, length, strict=True):
            np.testing.assert_array_equal(row[:count], begin + np.arange(count))
            assert set(row[count:]) <= {begin + count - 1}
