import jax
import numpy as np
import pytest

from lare_rl.credit import prequential
from lare_rl.credit.prequential import WINDOW, add_predictions, empty_predictions, squared_errors

gain, r2 = jax.jit(prequential.gain), jax.jit(prequential.r2)


def sample_predictions(count):
    random = np.random.default_rng(0)
    returns = random.normal(size=count).astype(np.float32)
    return returns, np.stack([returns + 0.5 * random.normal(size=count), 0 * returns], axis=1).astype(np.float32)


@jax.jit
def add_padded(predictions, *rows):
    return add_predictions(predictions, *rows)


def add(predictions, returns, predicted, mask=None, level=None):
    """Add episodes, with padding, so that all calls have the same shapes."""
    mask = np.ones(len(returns), bool) if mask is None else mask
    level = np.zeros(len(returns), int) if level is None else level
    padding = (0, WINDOW - len(returns))
    rows = (np.pad(values, (padding, (0, 0))[: values.ndim]) for values in (returns, predicted, mask, level))
    return add_padded(predictions, *rows)


@pytest.mark.parametrize("count", [8, WINDOW, 3 * WINDOW - 1])
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


def test_gain_against_numpy():
    rng = np.random.default_rng(0)
    level = rng.integers(0, 3, 25)
    level[7] = 5  # alone in its level
    returns = (level + rng.normal(size=25)).astype(np.float32)
    predicted = (returns + rng.normal(size=25)).astype(np.float32)
    predictions = add(empty_predictions(1), returns, predicted[:, None], level=level)
    peers = [[i for i in range(25) if i != k and (k == 7 or level[i] == level[k])] for k in range(25)]
    baseline = np.array([(returns[k] - returns[peers[k]].mean()) ** 2 for k in range(25)])
    error = (returns - predicted) ** 2
    want = 1 - error.sum() / baseline.sum()
    std_error = np.sqrt(25 / 24 * ((baseline - error - want * baseline) ** 2).sum()) / baseline.sum()
    np.testing.assert_allclose(gain(predictions), (want, std_error), rtol=1e-4)


def test_gain_covers_the_true_gain():
    """Chance explains most of a won or lost score: the gain is small, and its standard error says how well it is known."""
    rng = np.random.default_rng(1)
    chance = rng.choice(np.float32([0.3, 0.7]), (200, 256))
    won = (rng.random(chance.shape) < chance).astype(np.float32)
    compute = jax.vmap(lambda *rows: gain(add_predictions(empty_predictions(1, 256), *rows, None)))
    gains, errors = map(np.asarray, jax.jit(compute)(won, chance[..., None], np.ones(won.shape, bool)))
    np.testing.assert_allclose(gains.mean(), 0.16, atol=0.01)
    np.testing.assert_allclose(errors.mean(), gains.std(), rtol=0.2)


def test_few_equal_and_masked_returns():
    for returns in (np.arange(7.0), np.full(20, 3.1)):
        predictions = add(empty_predictions(1), returns, np.zeros((len(returns), 1)))
        assert np.isnan([*r2(predictions), *gain(predictions)]).all()
    returns, predicted = sample_predictions(20)
    mask = np.arange(20) % 3 > 0
    masked, expected = (
        add(empty_predictions(2), returns, predicted, mask),
        add(empty_predictions(2), returns[mask], predicted[mask]),
    )
    for a, b in zip(masked, expected, strict=True):
        np.testing.assert_array_equal(a, b)
