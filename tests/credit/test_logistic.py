import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import logistic
from lare_rl.util.float64 import float64

GROUP_INDEX = np.array([0, 0, 0, 1, 1, 1, 1, 1])
ROUNDS = 60
ALL = jnp.ones(len(GROUP_INDEX), bool)


def make_episodes(n_episodes, seed=0, scale=1.0):
    """Return sums of features, of which the first two matter, the chance to win, and returns of 0 or 10."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n_episodes, len(GROUP_INDEX)))
    chance = 1 / (1 + np.exp(1 - scale * (x[:, 0] - x[:, 1])))
    return x, chance, 10.0 * (rng.random(n_episodes) < chance)


def fit(x, returns, rounds=ROUNDS):
    state = logistic.init(GROUP_INDEX)
    with float64():
        state = logistic.add_episodes(state, jnp.asarray(x), jnp.asarray(returns), jnp.ones(len(x), bool))
        return logistic.fit(state, GROUP_INDEX, ALL, rounds)


def slow_fit(x, won, rounds):
    """The equations of the module, episode by episode, in NumPy."""
    n, size = x.shape
    trace = ((x - x.mean(axis=0)) ** 2).sum(axis=0)
    alpha = np.array([2 * trace[group == GROUP_INDEX].sum() / n for group in (0, 1)])
    bounds = alpha / 1e6, alpha * 1e6
    xi = np.ones(n)
    for _ in range(rounds):
        noise = np.tanh(xi / 2) / (2 * xi)
        target = (won - 0.5) / noise
        x_mean = sum(noise[k] * x[k] for k in range(n)) / noise.sum()
        target_mean = sum(noise * target) / noise.sum()
        precision, moment = np.diag(alpha[GROUP_INDEX]), np.zeros(size)
        for k in range(n):
            precision = precision + noise[k] * np.outer(x[k] - x_mean, x[k] - x_mean)
            moment = moment + noise[k] * (x[k] - x_mean) * (target[k] - target_mean)
        sigma = np.linalg.inv(precision)
        weight = sigma @ moment
        for k in range(n):
            difference = x[k] - x_mean
            variance = difference @ sigma @ difference + 1 / noise.sum()
            xi[k] = np.sqrt((target_mean + difference @ weight) ** 2 + variance)
        for group in (0, 1):
            members = group == GROUP_INDEX
            determined = members.sum() - alpha[group] * np.diag(sigma)[members].sum()
            alpha[group] = np.clip(determined / (weight[members] ** 2).sum(), bounds[0][group], bounds[1][group])
    return weight, target_mean - x_mean @ weight, alpha


def test_fit_equals_the_slow_twin():
    x, _, returns = make_episodes(40)
    state = fit(x.astype(np.float32).astype(float), returns, rounds=5)
    weight, bias, alpha = slow_fit(x.astype(np.float32).astype(float), returns > 5, rounds=5)
    np.testing.assert_allclose(state.posterior.weight, weight, rtol=1e-5)
    np.testing.assert_allclose(state.posterior.bias, bias, rtol=1e-5)
    np.testing.assert_allclose(state.posterior.alpha, alpha, rtol=1e-4)


@pytest.mark.parametrize("scale", [1.5, 50.0], ids=["with chance", "separable"])
def test_wins_are_predicted_better_than_by_least_squares(scale):
    x, _, returns = make_episodes(300, scale=scale)
    test_x, chance, _ = make_episodes(2000, seed=1, scale=scale)
    predicted = logistic.predict(fit(x, returns), jnp.asarray(test_x, jnp.float32))
    weights = np.linalg.lstsq(np.column_stack([np.ones(len(x)), x]), returns, rcond=None)[0]
    linear = np.column_stack([np.ones(len(test_x)), test_x]) @ weights
    error, linear_error = (np.mean((10 * chance - values) ** 2) for values in (np.asarray(predicted), linear))
    assert error < 0.6 * linear_error
    assert np.all((predicted >= 0) & (predicted <= 10))


def test_payments_are_in_the_unit_of_the_return():
    """The group that does not matter is switched off."""
    x, _, returns = make_episodes(300, scale=1.5)
    state, x = fit(x, returns), x.astype(np.float32)
    weight = np.asarray(state.posterior.weight)
    assert np.abs(weight[3:]).max() < 0.1 * np.abs(weight[:2]).min()
    start_value, slope = logistic.to_returns(state)
    payments = start_value + slope * (x @ weight)
    np.testing.assert_allclose(np.mean(payments), np.mean(logistic.predict(state, jnp.asarray(x))), rtol=1e-4)
    np.testing.assert_allclose(np.polyfit(payments, returns, 1)[0], 1, atol=0.15)


def test_equal_returns_and_the_window():
    x, _, _ = make_episodes(20)
    state = fit(x, np.full(20, 3.0))
    assert np.all(state.posterior.weight == 0)
    assert logistic.to_returns(state)[1] == 0
    x, _, returns = make_episodes(logistic.WINDOW + 10)
    state = logistic.init(GROUP_INDEX)
    with float64():
        for start in range(0, len(x), 18):
            chunk = jnp.asarray(np.arange(18) + start < len(x))
            rows = np.minimum(np.arange(18) + start, len(x) - 1)
            state = logistic.add_episodes(state, jnp.asarray(x[rows]), jnp.asarray(returns[rows]), chunk)
    assert sorted(np.asarray(state.columns)[:, 0]) == sorted(x[10:, 0].astype(np.float32))


def test_a_window_of_wins_keeps_the_fit():
    """A task that is solved does not lose its credit."""
    x, _, returns = make_episodes(100)
    state = fit(x, returns)
    wins, _, _ = make_episodes(logistic.WINDOW, seed=1)
    with float64():
        won = logistic.add_episodes(state, jnp.asarray(wins), jnp.full(len(wins), 10.0), jnp.ones(len(wins), bool))
        won = logistic.fit(won, GROUP_INDEX, ALL, ROUNDS)
    np.testing.assert_array_equal(won.posterior.weight, state.posterior.weight)
    assert logistic.to_returns(won)[1] > 0.5 * logistic.to_returns(state)[1] > 0
    assert 0 < float(logistic.predict(won, jnp.asarray(wins[:1]))[0]) < 10
