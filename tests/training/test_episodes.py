"""The replay of whole episodes: the newest are kept, and all of them drawn alike."""

import jax
import jax.numpy as jnp
import numpy as np

from lare.training import episodes


def numbered(first, count):
    """Episodes whose reward is their number."""
    reward = jnp.broadcast_to(jnp.arange(first, first + count, dtype=jnp.float32)[:, None, None], (count, 3, 2))
    return jnp.repeat(reward[..., None], 4, axis=-1), reward


def test_the_newest_stay():
    held = episodes.empty(5, 3, 2, 4)
    for first, count in ((0, 3), (3, 3), (6, 2)):
        held = episodes.extend(held, *numbered(first, count))
    assert sorted(np.asarray(held.reward[:, 0, 0])) == [3, 4, 5, 6, 7]
    np.testing.assert_array_equal(held.features[..., 0], held.reward)
    np.testing.assert_array_equal(held.reward[episodes.newest(held, 3), 0, 0], [7, 6, 5])


def test_only_what_is_there_is_drawn():
    held = episodes.extend(episodes.empty(100, 3, 2, 4), *numbered(0, 7))
    drawn = np.asarray(episodes.draw(held, jax.random.key(0), (5000,)))
    counts = np.bincount(drawn, minlength=7)
    assert len(counts) == 7
    assert counts.min() > 5000 / 7 * 0.8
