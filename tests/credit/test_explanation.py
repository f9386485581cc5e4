"""Explanations of episodes whose rewards are known functions of the inputs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.explanation import add_steps, empty_step_statistics
from lare_rl.credit.explanation import explain as explain_statistics

explain = jax.jit(explain_statistics, static_argnames="basis")
expand = jax.jit(expand, static_argnums=0)


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


@jax.jit
def episode_statistics(means, returns, length):
    return evidence.add_episodes(evidence.empty_statistics(means.shape[1]), means, returns, length)


@partial(jax.jit, static_argnums=1)
def step_statistics(features, basis):
    return add_steps(empty_step_statistics(basis), features, jnp.ones(len(features), bool), basis)


def sample_inputs(n_inputs, count, seed=0):
    """Return inputs of steps that vary within episodes and between them, and the lengths of the episodes."""
    random = np.random.default_rng(seed)
    episode_mean = random.normal(size=(count, n_inputs))
    length = random.integers(10, 30, size=count)
    return np.repeat(episode_mean, length, axis=0) + random.normal(size=(length.sum(), n_inputs)), length


def explain_rewards(basis, u, length, reward, score_type=0):
    """Explain episodes with these inputs and rewards, of which the score is the sum or the mean."""
    starts, features = np.append(0, np.cumsum(length)[:-1]), np.asarray(expand(basis, u))
    means = np.add.reduceat(features, starts) / length[:, None]
    returns = np.add.reduceat(reward, starts) / (length if score_type else 1)
    return explain(episode_statistics(means, returns, length), step_statistics(features, basis), score_type, basis)


def explain_function(basis, function, count=120, noise=0.1, score_type=0):
    """Explain episodes of about 20 steps whose reward is a function of the inputs, or weights times them."""
    u, length = sample_inputs(basis.n_inputs, count)
    reward = function(u) if callable(function) else u @ np.array(function)
    noise = noise * np.random.default_rng([0, 1]).normal(size=len(u))
    return explain_rewards(basis, u, length, reward + noise, score_type)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("score_type", [0, 1])
def test_linear_rewards(extended, score_type):
    """The factors vary alike, so that their shares are proportional to the squares of their weights."""
    basis = Basis(3, 2, extended)
    explanation = explain_function(basis, [2.0, -1.0, 0, 0, 0], score_type=score_type)
    _, length = sample_inputs(5, 120)
    unit = length.mean() if score_type else 1  # a step of a mean gets a T-th of the reward
    assert float(explanation.n_episodes) == 120
    assert bool(explanation.explains_mean_reward) == (score_type == 0)
    assert float(explanation.factors_r2) > 0.98
    np.testing.assert_allclose(explanation.factor_shares, [0.8, 0.2, 0], atol=0.1)
    slope, std = np.asarray(explanation.slope) * unit, np.sqrt(np.diagonal(explanation.slope_covariance)) * unit
    np.testing.assert_allclose(slope, [2, -1, 0], atol=0.15)
    assert (std > 0).all()
    assert (np.abs(slope - [2, -1, 0]) < 4 * std + 0.02).all()


def test_episodes_of_the_same_length_are_explained_by_returns():
    basis, u = Basis(2, 0, extended=False), np.random.default_rng(0).normal(size=(210, 2))
    assert not explain_rewards(basis, u, np.full(30, 7), u @ [2.0, -1.0]).explains_mean_reward


def test_residual_correlates_with_the_missing_raw_feature():
    explanation = explain_function(Basis(2, 3, extended=True), [1.0, 0, 0, -1.0, 0])
    assert 0.3 < float(explanation.factors_r2) < 0.7
    assert float(explanation.total_r2) > 0.98
    correlation = np.asarray(explanation.residual_correlation)
    assert correlation[1] < -0.9
    assert np.abs(correlation[[0, 2]]).max() < 0.4


def test_raw_feature_shares():
    """The effect of two raw features, a line and a pair with a third one, is twice that of the factor."""
    explanation = explain_function(
        Basis(1, 3, extended=True), lambda u: u[:, 0] + 2 * u[:, 1] + 2 * u[:, 2] * u[:, 3], noise=0.01
    )
    line, first, second = np.asarray(explanation.raw_feature_shares)
    raw_share = float(explanation.total_r2) - float(explanation.factors_r2)
    assert float(explanation.total_r2) > 0.98
    assert first == pytest.approx(second, abs=0.1)
    assert 0.5 < raw_share < 0.95
    assert line + first + second == pytest.approx(raw_share, abs=0.1)
    assert min(line, first + second) > 0.2


def test_useless_factors_and_no_factors():
    useless = explain_function(Basis(2, 1, extended=False), [0, 0, 1.0])
    assert float(useless.factors_r2) < 0.1
    assert float(useless.total_r2) > 0.98
    none = explain_function(Basis(0, 3, extended=False), [1.0, 0, 0])
    assert (float(none.factors_r2), none.factor_shares.shape, none.slope.shape) == (0, (0,), (0,))
    assert float(none.total_r2) > 0.98
    np.testing.assert_allclose(none.raw_feature_shares, [none.total_r2, 0, 0], atol=0.02)


def test_raw_feature_that_never_varies_has_no_correlation():
    basis, (u, length) = Basis(1, 2, extended=False), sample_inputs(3, 120)
    u[:, 2] = 0
    assert float(explain_rewards(basis, u, length, u @ [1.0, 1.0, 0]).residual_correlation[1]) == 0


def test_factor_varies():
    """The second factor varies within episodes only, but for rounding, so that returns do not determine its effect."""
    u = np.random.default_rng(0).normal(size=(320, 2))
    u[:, 1] = np.tile([1.0, 1, 1, -1, -1, -1, -1, 1], 40) + 1e-9 * u[:, 0]
    explanation = explain_rewards(Basis(2, 0, extended=False), u, np.full(40, 8), u @ [1.0, 1.0])
    assert explanation.factor_varies.tolist() == [True, False]


@pytest.mark.parametrize("count", [1, 2])
def test_few_episodes_explain_nothing(count):
    assert np.isnan(explain_function(Basis(1, 1, extended=False), [1.0, 1.0], count=count).total_r2)


@pytest.mark.parametrize("noise", [0.1, 3.0])
def test_factor_shares_add_up(noise):
    explanation = explain_function(Basis(3, 2, extended=True), [2.0, -1.0, 0.5, 1.0, 0], count=30, noise=noise)
    assert 0 < float(explanation.factors_r2) < 1
    assert float(explanation.factor_shares.sum()) == pytest.approx(float(explanation.factors_r2))


def test_factor_that_offsets_another_has_a_negative_share():
    """A cost grows with the gain. Its share is -Cov(cost, return) / Var(return), and that of the gain is above 1."""
    basis, random = Basis(2, 0, extended=False), np.random.default_rng(3)
    gain = random.normal(size=200)
    means = np.stack([gain, 0.8 * gain + 0.3 * random.normal(size=200)], axis=1)
    returns = means @ [2.0, -1.0]
    statistics = episode_statistics(means, 20 * returns, np.full(200, 20))
    explanation = explain(statistics, step_statistics(means, basis), 0, basis)
    np.testing.assert_allclose(explanation.slope, [2, -1], rtol=1e-3)
    covariance = [np.cov(column, returns)[0, 1] for column in means.T]
    want = np.array([2, -1]) * covariance / returns.var(ddof=1)
    assert want[1] < -0.3
    np.testing.assert_allclose(explanation.factor_shares, want, rtol=1e-2)


@pytest.mark.parametrize("count", [30, 100])
def test_slope_is_that_of_the_closest_line(count):
    """|u| bends the shapes of all factors, and a sine then replaces the second factor's line."""
    u, length = sample_inputs(2, count)
    effects = np.stack([-2 * np.abs(u[:, 0]), 0.5 * u[:, 1]], axis=1)
    explanation = explain_rewards(Basis(2, 0, extended=True), u, length, effects.sum(axis=1))
    want = [np.polyfit(u[:, i], effects[:, i], 1)[0] for i in range(2)]
    np.testing.assert_allclose(explanation.slope, want, atol=0.05)
    assert float(explanation.linear_share[0]) < 0.1
    assert float(explanation.linear_share[1]) > 0.9
    np.testing.assert_allclose(explanation.pair_shares, 0, atol=0.02)


@pytest.mark.parametrize("count", [30, 100])
def test_effect_of_a_rare_event(count):
    """An event has two values, so that all of its shapes are one line. Only the sum of its weights is determined."""
    random = np.random.default_rng(0)
    length = random.integers(20, 40, size=count)
    event = random.random(length.sum()) < 0.03
    std = event.std()
    u = np.stack([(event - event.mean()) / std, random.normal(size=len(event))], axis=1)
    reward = 5.0 * event + 0.01 * random.normal(size=len(event))
    explanation = explain_rewards(Basis(2, 0, extended=True), u, length, reward)
    assert float(explanation.slope[0]) == pytest.approx(5 * std, rel=0.02)
    assert float(explanation.slope_covariance[0, 0]) < 0.02**2
    assert float(explanation.linear_share[0]) == pytest.approx(1, abs=1e-3)


def test_pair_shares():
    explanation = explain_function(Basis(2, 0, extended=True), lambda u: u[:, 0] * u[:, 1], count=100)
    np.testing.assert_allclose(explanation.pair_shares, explanation.factor_shares, atol=0.1)
    np.testing.assert_allclose(explanation.slope, 0, atol=0.1)
