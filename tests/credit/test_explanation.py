"""What is explained, by which factor, and what is missing: on episodes whose score is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare.credit import evidence
from lare.credit.basis import Basis, expand
from lare.credit.explanation import explain


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def summed(basis, weight, count=120, seed=0, noise=0.1, form=0):
    """Sums over episodes of 20 steps that pay `weight` times the inputs, or their average."""
    random = np.random.default_rng(seed)
    mood = random.normal(size=(count, basis.inputs))
    length = random.integers(10, 30, size=count)
    means, returns = [], []
    for one, steps in zip(mood, length, strict=True):
        u = one + random.normal(size=(steps, basis.inputs))
        means.append(np.asarray(expand(basis, jnp.asarray(u))).mean(axis=0))
        paid = (u @ weight + noise * random.normal(size=steps)).sum()
        returns.append(paid / steps if form else paid)
    given = (jnp.asarray(part) for part in (np.array(means), np.array(returns), length))
    return evidence.add_episodes(evidence.no_sums(basis.size), *given)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("form", [0, 1])
def test_factors_that_tell_all(extended, form):
    """Two factors that vary alike: shares go as the squares of their weights."""
    basis = Basis(3, 2, extended)
    found = explain(summed(basis, np.array([2.0, -1.0, 0, 0, 0]), form=form), form, basis)
    assert float(found.episodes) == 120
    assert float(found.by_factors) > 0.98
    np.testing.assert_allclose(found.share, [0.8, 0.2, 0], atol=0.1)
    np.testing.assert_allclose(found.weight, [2, -1, 0], atol=0.15)
    assert (np.asarray(found.deviation) > 0).all()
    assert (np.abs(np.asarray(found.weight) - [2, -1, 0]) < 4 * np.asarray(found.deviation) + 0.02).all()


def test_what_the_factors_leave_goes_with_the_entry_that_is_missing():
    basis = Basis(2, 3, extended=True)
    found = explain(summed(basis, np.array([1.0, 0, 0, -1.0, 0])), 0, basis)
    assert 0.3 < float(found.by_factors) < 0.7
    assert float(found.by_all) > 0.98
    left = np.asarray(found.left)
    assert left[1] < -0.9
    assert np.abs(left[[0, 2]]).max() < 0.4


def test_factors_that_tell_nothing():
    basis = Basis(2, 1, extended=False)
    found = explain(summed(basis, np.array([0, 0, 1.0])), 0, basis)
    assert float(found.by_factors) < 0.1
    assert float(found.by_all) > 0.98


def test_without_factors_the_entries_tell():
    found = explain(summed(Basis(0, 3, extended=False), np.array([1.0, 0, 0])), 0, Basis(0, 3, extended=False))
    assert (float(found.by_factors), found.share.shape, found.weight.shape) == (0, (0,), (0,))
    assert float(found.by_all) > 0.98


def test_an_entry_that_never_varies_goes_with_nothing():
    basis = Basis(1, 2, extended=False)
    sums = summed(basis, np.array([1.0, 1.0, 0]))
    products = sums.products.at[2, :].set(0).at[:, 2].set(0)
    assert float(explain(sums._replace(products=products), 0, basis).left[1]) == 0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_of_few_episodes_nothing_is_said(count):
    basis = Basis(1, 1, extended=False)
    found = explain(summed(basis, np.ones(2), count=max(count, 1)) if count else evidence.no_sums(2), 0, basis)
    assert np.isnan(found.by_all)
