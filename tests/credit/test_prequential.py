import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.prequential import WINDOW, add_predictions, empty_predictions, r2, squared_errors


def sample_predictions(count):
    random = np.random.default_rng(0)
    returns = random.normal(size=count).astype(np.float32)
    return returns, np.stack([returns + 0.5 * random.normal(size=count), 0 * returns], axis=1).astype(np.float32)


def add(predictions, returns, predicted, mask=None):
    mask = np.ones(len(returns), bool) if mask is None else mask
    return add_predictions(predictions, *map(jnp.asarray, (returns, predicted, mask)))


@pytest.mark.parametrize("count", [8, 30, WINDOW, WINDOW + 5, 3 * WINDOW - 1])
def test_r2_against_numpy(count):
    returns, predicted = sample_predictions(count)
    predictions = empty_predictions(2)
    for chunk in np.array_split(np.arange(count), 1 + count // 20):
        predictions = add(predictions, returns[chunk], predicted[chunk])
    assert float(predictions.n_episodes) == count
    returns, predicted = returns[-WINDOW:], predicted[-WINDOW:]
    errors = ((returns[:, None] - predicted) ** 2).sum(axis=0)
    np.testing.assert_allclose(squared_errors(predictions), errors, rtol=1e-4)
    want = 1 - errors / ((returns - returns.mean()) ** 2).sum()
    np.testing.assert_allclose(r2(predictions), want, rtol=1e-4, atol=1e-5)


def test_masked_episodes_are_ignored():
    returns, predicted = sample_predictions(20)
    mask = np.arange(20) % 3 > 0
    masked = add(empty_predictions(2), returns, predicted, mask)
    for a, b in zip(masked, add(empty_predictions(2), returns[mask], predicted[mask]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("returns", [np.arange(7.0), np.full(20, 3.1)], ids=["few", "equal"])
def test_r2_is_nan(returns):
    assert np.isnan(r2(add(empty_predictions(1), returns, np.zeros((len(returns), 1))))).all()
