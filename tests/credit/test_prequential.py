"""R^2 of predictions that were made before the returns were known, over the last episodes only."""

import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.prequential import FEWEST, LAST, no_predictions, r2, remember, squared_errors

ALL = jnp.ones


def some(count, seed=0):
    random = np.random.default_rng(seed)
    returns = random.normal(size=count).astype(np.float32)
    return returns, np.stack([returns + 0.5 * random.normal(size=count), 0 * returns], axis=1).astype(np.float32)


def by_hand(returns, predicted):
    return 1 - ((returns[:, None] - predicted) ** 2).sum(axis=0) / ((returns - returns.mean()) ** 2).sum()


@pytest.mark.parametrize("count", [FEWEST, 30, LAST, LAST + 5, 3 * LAST - 1])
def test_against_numpy_however_the_episodes_come(count):
    returns, predicted = some(count)
    known = no_predictions(2)
    for piece in np.array_split(np.arange(count), 1 + count // 20):
        known = remember(known, jnp.asarray(returns[piece]), jnp.asarray(predicted[piece]), ALL(len(piece), bool))
    assert float(known.episodes) == count
    np.testing.assert_allclose(r2(known), by_hand(returns[-LAST:], predicted[-LAST:]), rtol=1e-4, atol=1e-5)
    want = ((returns[-LAST:, None] - predicted[-LAST:]) ** 2).sum(axis=0)
    np.testing.assert_allclose(squared_errors(known), want, rtol=1e-4)


def test_episodes_that_are_masked_leave_nothing():
    returns, predicted = some(20)
    mask = np.arange(20) % 3 > 0
    one = remember(no_predictions(2), jnp.asarray(returns), jnp.asarray(predicted), jnp.asarray(mask))
    other = remember(no_predictions(2), jnp.asarray(returns[mask]), jnp.asarray(predicted[mask]), ALL(mask.sum(), bool))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("returns", [np.arange(FEWEST - 1.0), np.full(20, 3.1)], ids=["few", "all the same"])
def test_where_nothing_can_be_said(returns):
    known = remember(no_predictions(1), jnp.asarray(returns), jnp.zeros((len(returns), 1)), ALL(len(returns), bool))
    assert np.isnan(r2(known)).all()
