"""The regression on prefixes against dense matrices, and against the engine's moments."""

from itertools import product

import numpy as np
import pytest

from helpers.turn_toys import dense_posterior, sample_table
from lare_rl.credit.precisions import NUMPY_BACKEND, Regression
from lare_rl.turns.features import build_prefixes
from lare_rl.turns.regression import fit_linear, fixed_point, group_moments, sum_up


@pytest.fixture
def prefixes():
    """Return features, outcomes, weights and groups of prefixes, and the number of rollouts."""
    table = sample_table()
    index = table.rollout_index
    x = build_prefixes(table).features
    n = len(table.length)
    return x, table.outcome[index], np.full(len(x), n / len(x)), table.group[index], n


def dense_problem(x, y, weight, group, sums):
    """Return the problem with the whole matrix S of features and groups, m integrated out."""
    design = np.column_stack([x, np.eye(group.max() + 1)[group]])
    total = weight.sum()
    centred = design - weight @ design / total
    y = (y - weight @ y / total) / sums.problem.y_std
    return Regression(
        s=centred.T @ (weight[:, None] * centred),
        p=centred.T @ (weight * y),
        q=weight @ y**2,
        dof=sums.problem.dof,
        y_mean=sums.problem.y_mean,
        y_std=sums.problem.y_std,
        alpha_index=sums.problem.alpha_index,
        equal_alpha=sums.problem.equal_alpha,
    )


@pytest.mark.parametrize("beta", [0.5, 20.0])
def test_moments_are_those_of_the_engine(prefixes, beta):
    x, y, weight, group, n = prefixes
    sums = sum_up(x, y, weight, group, n)
    alpha = np.random.default_rng(0).lognormal(size=x.shape[1] + 1)
    dense = NUMPY_BACKEND.dense_moments(dense_problem(x, y, weight, group, sums), alpha, beta)
    for name, expected in dense._asdict().items():
        np.testing.assert_allclose(getattr(group_moments(sums, alpha, beta), name), expected, rtol=1e-6, atol=1e-7)


def test_posterior_is_that_of_one_large_matrix(prefixes):
    x, y, weight, group, n = prefixes
    fit = fit_linear(x, y, weight, group, n)
    n_features = x.shape[1]
    sums = sum_up(x, y, weight, group, n)
    best = max(
        (fixed_point(sums, sums.problem.equal_alpha * factor, 2 * (n - 1) / n) for factor in (1.0, 1e3)),
        key=lambda posterior: posterior.log_evidence,
    )
    y_std = sums.problem.y_std
    mean, covariance, _ = dense_posterior(x, y, weight, group, best.alpha / y_std**2, best.beta / y_std**2)
    np.testing.assert_allclose(fit.coefficients, mean[:n_features], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(fit.intercept, mean[n_features + 1 :], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(fit.mean - fit.x_mean @ fit.coefficients, mean[n_features], rtol=1e-5, atol=1e-8)
    covariance_v = (fit.root.T @ fit.root)[:n_features, :n_features]
    np.testing.assert_allclose(covariance_v, covariance[:n_features, :n_features], rtol=1e-4, atol=1e-9)


def test_precisions_maximise_the_evidence(prefixes):
    x, y, weight, group, n = prefixes
    sums = sum_up(x, y, weight, group, n)
    best = fixed_point(sums, sums.problem.equal_alpha, 2.0, max_rounds=2000)

    def log_evidence(alpha, beta):
        moments = group_moments(sums, alpha, beta)
        size = np.bincount(sums.problem.alpha_index)
        squares = np.bincount(sums.problem.alpha_index, moments.weight**2)
        terms = sums.problem.dof * np.log(beta) + size @ np.log(alpha) - moments.log_det
        return 0.5 * (terms - beta * moments.residual - alpha @ squares)

    at_best = log_evidence(best.alpha, best.beta)
    assert all(log_evidence(best.alpha, best.beta * factor) <= at_best + 1e-2 for factor in (0.8, 1.25))
    for i, factor in product(range(len(best.alpha)), (0.5, 2.0)):
        alpha = np.where(np.arange(len(best.alpha)) == i, factor, 1) * best.alpha
        assert log_evidence(alpha, best.beta) <= at_best + 1e-2


@pytest.mark.parametrize("outcome", [0.0, 1.0, 1e6])
def test_equal_outcomes_give_no_weight(prefixes, outcome):
    x, y, weight, group, n = prefixes
    fit = fit_linear(x, np.full_like(y, outcome), weight, group, n)
    assert not fit.coefficients.any()
    assert fit.mean == pytest.approx(outcome)
