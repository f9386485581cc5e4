"""Closed forms against plain NumPy, and the confidence radius against what it promises."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.credit.closed_form import (
    add_steps,
    best_signs,
    forget_running,
    new_totals,
    radius,
    ridge_regression,
    uncertainty,
)

LENGTHS = (3, 7, 5, 9, 4, 6, 8)
WEIGHT = np.array([1.5, -2.0, 0.5])


def episodes(seed=0, noise=0.0, offset=0.0, count=1):
    """Steps one behind the other: features, R/T where an episode ended, and where that is."""
    rng, lengths = np.random.default_rng(seed), LENGTHS * count
    rows = rng.normal(size=(sum(lengths), 3)) + offset
    reward = rows @ WEIGHT + 0.7 + noise * rng.normal(size=len(rows))
    ended = np.zeros(len(rows), bool)
    ended[np.cumsum(lengths) - 1] = True
    pieces = np.split(np.arange(len(rows)), np.cumsum(lengths)[:-1])
    z = np.array([rows[piece].mean(axis=0) for piece in pieces])
    y = np.array([reward[piece].mean() for piece in pieces])
    at_its_end = np.full(len(rows), 99.0)
    at_its_end[ended] = y
    return rows, at_its_end, ended, z, y


def taken(rows, at_its_end, ended, parts=1):
    totals = new_totals(rows.shape[1])
    for piece in np.array_split(np.arange(len(rows)), parts):
        given = (jnp.asarray(part[piece][:, None], jnp.float32) for part in (rows, at_its_end))
        totals = jax.jit(add_steps)(totals, *given, jnp.asarray(ended[piece][:, None]))
    return totals


@pytest.mark.parametrize("parts", [1, 6])
@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_totals_against_numpy(parts, offset):
    """In whatever pieces the steps come, and without cancellation where the mean is far from 0."""
    rows, at_its_end, ended, z, y = episodes(offset=offset)
    totals = taken(rows, at_its_end, ended, parts)
    v = np.column_stack([z, y])
    assert float(totals.episodes) == len(LENGTHS)
    np.testing.assert_allclose(totals.mean, v.mean(axis=0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(totals.products, (v - v.mean(axis=0)).T @ (v - v.mean(axis=0)), rtol=1e-2, atol=1e-2)
    assert float(totals.farthest) == pytest.approx(np.abs(y).max(), rel=1e-5)


def test_ridge_against_numpy():
    rows, at_its_end, ended, z, y = episodes(noise=0.5)
    found = ridge_regression(taken(rows, at_its_end, ended), ridge=2.0)
    unit = z.std(axis=0)
    x = (z - z.mean(axis=0)) / unit
    w = np.linalg.solve(x.T @ x + 2.0 * np.eye(3), x.T @ (y - y.mean())) / unit
    np.testing.assert_allclose(found.weight, w, rtol=1e-3)
    assert float(found.bias) == pytest.approx(y.mean() - w @ z.mean(axis=0), rel=1e-3)


def test_without_noise_ridge_finds_the_rewards():
    rows, at_its_end, ended, *_ = episodes(count=4)
    found = ridge_regression(taken(rows, at_its_end, ended), ridge=1e-4)
    np.testing.assert_allclose(found.weight, WEIGHT, rtol=1e-2)
    assert float(found.bias) == pytest.approx(0.7, rel=1e-2)


def test_a_feature_that_never_varies_takes_no_weight():
    rows, at_its_end, ended, *_ = episodes(count=2)
    rows[:, 1] = 5.0
    found = ridge_regression(taken(rows, at_its_end, ended), ridge=1.0)
    assert float(found.weight[1]) == 0
    assert np.isfinite(found.weight).all()


@pytest.mark.parametrize("seed", range(5))
def test_signs_against_trying_all(seed):
    rows, at_its_end, ended, z, y = episodes(seed, noise=2.0)
    found = best_signs(taken(rows, at_its_end, ended))
    errors = {signs: ((z @ signs - y) ** 2).sum() for signs in itertools.product((1.0, -1.0), repeat=3)}
    assert tuple(np.asarray(found.weight)) == min(errors, key=errors.get)
    assert float(found.bias) == 0


def test_an_episode_that_is_forgotten_leaves_nothing():
    rows, at_its_end, ended, *_ = episodes()
    whole = taken(rows, at_its_end, ended)
    begun = add_steps(whole, jnp.ones((2, 1, 3)), jnp.zeros((2, 1)), jnp.zeros((2, 1), bool))
    assert begun.steps.tolist() == [2]
    for a, b in zip(jax.tree.leaves(forget_running(begun, jnp.array([True]))), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b)


def several(parts, envs=3):
    """The same of steps that come from several environments at a time, whose episodes end anywhere."""
    given = [episodes(seed, noise=0.5) for seed in range(envs)]
    rows, at_its_end, ended = (np.stack([one[part] for one in given], axis=1) for part in range(3))
    ended[LENGTHS[0] + LENGTHS[1] - 1, 0] = False  # the first environment's second episode goes on into its third
    totals, add = new_totals(3, envs), jax.jit(add_steps)
    for piece in np.array_split(np.arange(len(rows)), parts):
        totals = add(
            *(totals, jnp.asarray(rows[piece], jnp.float32), jnp.asarray(at_its_end[piece], jnp.float32)), ended[piece]
        )
    v = [
        np.append(rows[piece, env].mean(axis=0), at_its_end[piece[-1], env])
        for env in range(envs)
        for piece in np.split(np.arange(len(rows)), np.flatnonzero(ended[:, env]) + 1)
        if len(piece)
    ]
    return totals, np.array(v)


@pytest.mark.parametrize("parts", [1, 6])
def test_totals_of_several_environments(parts):
    totals, v = several(parts)
    assert float(totals.episodes) == len(v) == 3 * len(LENGTHS) - 1
    np.testing.assert_allclose(totals.mean, v.mean(axis=0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(totals.products, (v - v.mean(axis=0)).T @ (v - v.mean(axis=0)), rtol=1e-3, atol=1e-4)


def test_only_the_episodes_of_some_environments_are_forgotten():
    begun = add_steps(new_totals(3, 2), jnp.ones((2, 2, 3)), jnp.zeros((2, 2)), jnp.zeros((2, 2), bool))
    left = forget_running(begun, jnp.array([True, False]))
    assert left.steps.tolist() == [0, 2]
    np.testing.assert_array_equal(left.running, [[0, 0, 0], [1, 1, 1]])


def test_the_radius_by_hand():
    rows, at_its_end, ended, z, y = episodes()
    totals = taken(rows, at_its_end, ended)
    # d = 3, and the squares of x_k, 1 and those of 3 factors in units of their deviation, add up to 4 times the episodes.
    count = len(LENGTHS)
    grown = np.log((1 + 4 * count / 2.0) / (0.1 / 10))
    left = y - np.asarray(ridge_regression(totals, 2.0)(jnp.asarray(z, jnp.float32), None).r_hat)
    sigma = np.sqrt((left**2).sum() / (count - 4))
    want = sigma * np.sqrt(4 * grown) + np.abs(y).max() * np.sqrt(2.0 * 3)
    assert float(radius(totals, 2.0, 0.1)) == pytest.approx(want, rel=1e-3)


def test_the_radius_of_few_episodes_knows_nothing_of_noise():
    """As many weights as episodes leave no residuals."""
    rows, at_its_end, ended, *_ = episodes()
    steps = sum(LENGTHS[:4])
    totals = taken(rows[:steps], at_its_end[:steps], ended[:steps])
    grown = np.log((1 + 4 * 4 / 2.0) / (0.1 / 10))
    want = float(totals.farthest) * (np.sqrt(4 * grown) + np.sqrt(2.0 * 3))
    assert float(radius(totals, 2.0, 0.1)) == pytest.approx(want, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_uncertainty_holds_of_rare_rewards_at_the_mean(seed):
    """A reward of 1 in 50 steps, which has nothing to do with the factors: what is not known is how often it comes."""
    rng, episodes_of_50 = np.random.default_rng(seed), 60
    rows = rng.normal(size=(50 * episodes_of_50, 3))
    ended = np.arange(1, len(rows) + 1) % 50 == 0
    means = (rng.random((episodes_of_50, 50)) < 0.02).mean(axis=1)
    totals = taken(rows, np.repeat(means, 50), ended)
    at_the_mean = totals.mean[None, :-1]
    away = abs(float(ridge_regression(totals, 1.0)(at_the_mean, None).r_hat[0]) - 0.02)
    width = float(uncertainty(totals, at_the_mean, 1.0, 0.5)[0])
    assert away <= width < 0.05


def test_uncertainty_holds_and_shrinks():
    """Rewards that are linear in the factors lie within it, and more episodes make it smaller."""
    widths = []
    for count in (1, 16):
        rows, at_its_end, ended, *_ = episodes(noise=0.3, count=count)
        totals = taken(rows, at_its_end, ended)
        found = ridge_regression(totals, 1.0)
        x = jnp.asarray(rows[:50], jnp.float32)
        width = uncertainty(totals, x, ridge=1.0, delta=0.1)
        r_hat = found(x, None).r_hat
        assert (np.abs(r_hat - (rows[:50] @ WEIGHT + 0.7)) <= np.asarray(width)).all()
        widths.append(float(width.mean()))
    assert widths[1] < widths[0] / 2


def test_a_constant_says_nothing_however_long_episodes_are():
    """The sum of 0.1, divided by the length, is 0.1 and a rounding error that tells the length."""
    random, totals = np.random.default_rng(0), new_totals(2)
    take = jax.jit(add_steps)
    lengths = random.integers(20, 999, 60)
    for length in lengths:
        factors = np.stack([random.normal(size=length), np.full(length, 0.1)], axis=1).astype(np.float32)
        paid, ended = np.full(999, 0.5 + length / 500, np.float32), np.arange(999) == length - 1
        padded = np.concatenate([factors, np.full((999 - length, 2), 0.1, np.float32)])
        given = (jnp.asarray(part)[:, None] for part in (padded, paid, ended))
        totals = forget_running(take(totals, *given), jnp.array([True]))
    decoder = ridge_regression(totals, 1.0)
    assert float(decoder.weight[1]) == 0
    assert float(decoder.bias) == pytest.approx((0.5 + lengths / 500).mean(), abs=0.2)
