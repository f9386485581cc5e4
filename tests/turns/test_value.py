"""Values, changes, advantages and posterior standard deviations against slow twins."""

import numpy as np
import pytest

from helpers.turn_toys import dense_posterior, sample_table, slow_prefix
from lare_rl.turns.features import build_prefixes
from lare_rl.turns.regression import PrefixFit
from lare_rl.turns.value import advantages, changes, held_out_values, posterior_stds, values

ALPHA, BETA = 2.0, 5.0


def rows_of(table, k):
    return slice(table.first[k], table.first[k] + table.length[k])


def simple_fit(table, x, alpha=ALPHA, beta=BETA, skip=None):
    """Return the posterior under equal precisions from one large matrix, without one rollout."""
    index = table.rollout_index
    weight = np.where(index == skip, 0.0, len(table.length) / len(x))
    group = table.group[index]
    mean, covariance, _ = dense_posterior(x, table.outcome[index], weight, group, np.full(x.shape[1] + 1, alpha), beta)
    return mean, covariance


def linear_fit(table, x):
    """Return the same posterior as a `PrefixFit`."""
    mean, covariance = simple_fit(table, x)
    n = x.shape[1]
    x_mean = x.mean(axis=0)
    shift = np.eye(n + 1)
    shift[n, :n] = x_mean  # (v, m) -> (v, m + v . x_mean)
    weight = len(table.length) / len(x)
    index = table.rollout_index
    counts = np.bincount(table.group[index]) * weight
    sums = np.array([x[table.group[index] == g].sum(axis=0) for g in range(len(counts))]) * weight
    precision = BETA * counts + ALPHA
    rows = BETA * np.column_stack([sums - counts[:, None] * x_mean, counts]) / precision[:, None]
    return PrefixFit(
        x_mean=x_mean,
        coefficients=mean[:n],
        mean=float(mean[n] + mean[:n] @ x_mean),
        intercept=mean[n + 1 :],
        root=np.linalg.cholesky(shift @ covariance[: n + 1, : n + 1] @ shift.T).T,
        group_row=rows,
        group_precision=precision,
        noise_variance=1 / BETA,
    )


def test_prefixes_are_as_the_equation_says():
    table = sample_table()
    prefixes = build_prefixes(table)
    slow = np.concatenate(
        [[slow_prefix(table.features[rows_of(table, k)], t) for t in range(n)] for k, n in enumerate(table.length)]
    )
    np.testing.assert_array_equal(prefixes.features, slow[:, np.ptp(slow, axis=0) > 0])


@pytest.mark.parametrize("lambda_", [0.0, 0.8, 1.0])
def test_advantages_are_discounted_sums_of_changes(lambda_):
    table = sample_table()
    value = np.random.default_rng(1).normal(size=len(table.features))
    change = changes(table, value)
    np.testing.assert_allclose(np.bincount(table.rollout_index, change), table.outcome - value[table.first])
    result = advantages(table, change, lambda_)
    for k in range(len(table.length)):
        discount = lambda_ ** np.arange(table.length[k])
        rows = change[rows_of(table, k)]
        expected = [rows[t:] @ discount[: len(rows) - t] for t in range(len(rows))]
        np.testing.assert_allclose(result[rows_of(table, k)], expected)


@pytest.fixture
def problem():
    """Return a table, its prefixes and a fit to them."""
    table = sample_table()
    x = build_prefixes(table).features
    return table, x, linear_fit(table, x)


def test_values_leave_out_the_rollout_itself(problem):
    """The intercept is that of a regression in which the rollout has no weight, with the same v and m."""
    table, x, fit = problem
    result = values(table, x, fit)
    index = table.rollout_index
    base = fit.mean + (x - fit.x_mean) @ fit.coefficients
    weight = len(table.length) / len(x)
    for k in range(len(table.length)):
        in_group = (table.group[index] == table.group[k]) & (index != k)
        residual = weight * (table.outcome[index] - base)[in_group].sum()
        intercept = residual / (weight * in_group.sum() + ALPHA / BETA)
        np.testing.assert_allclose(result[rows_of(table, k)], base[rows_of(table, k)] + intercept)


def test_held_out_values_are_those_of_a_fit_without_the_rollout(problem):
    table, x, fit = problem
    result = held_out_values(table, x, fit)
    for k in range(len(table.length)):
        mean, _ = simple_fit(table, x, skip=k)
        n = x.shape[1]
        expected = x[rows_of(table, k)] @ mean[:n] + mean[n] + mean[n + 1 + table.group[k]]
        np.testing.assert_allclose(result[rows_of(table, k)], expected, rtol=1e-6, atol=1e-8)


def test_posterior_stds_are_those_of_the_posterior(problem):
    table, x, fit = problem
    _, covariance = simple_fit(table, x)
    result = posterior_stds(table, x, fit)
    n_groups = table.group.max() + 1
    for k in range(len(table.length)):
        rows = x[rows_of(table, k)]
        last = np.concatenate([rows[-1], [1.0], np.eye(n_groups)[table.group[k]]])
        steps = [np.concatenate([step, np.zeros(1 + n_groups)]) for step in np.diff(rows, axis=0)]
        expected = [np.sqrt(row @ covariance @ row) for row in [*steps, last]]
        np.testing.assert_allclose(result[rows_of(table, k)], expected, rtol=1e-6)
