"""What is explained, by which factor, and what is missing: on episodes whose score is known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.explanation import add_steps, no_steps
from lare_rl.credit.explanation import explain as explain_sums

explain = jax.jit(explain_sums, static_argnames="basis")


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def summed(basis, reward, count=120, seed=0, noise=0.1, form=0):
    """Sums over episodes of about 20 steps that pay a function of the inputs, or weights times them; or the average of this."""
    u, length = moody(basis.inputs, count, seed)
    paid = reward(u) if callable(reward) else u @ reward
    return summed_over(basis, u, length, paid + noise * np.random.default_rng([seed, 1]).normal(size=len(u)), form)


def moody(inputs, count, seed=0):
    """Steps whose inputs vary within episodes and between them, and the lengths of the episodes."""
    random = np.random.default_rng(seed)
    mood = random.normal(size=(count, inputs))
    length = random.integers(10, 30, size=count)
    return np.repeat(mood, length, axis=0) + random.normal(size=(length.sum(), inputs)), length


def means_of(values, length):
    return np.add.reduceat(values, np.append(0, np.cumsum(length)[:-1])) / length.reshape(-1, *[1] * (values.ndim - 1))


def summed_over(basis, u, length, paid, form=0):
    """The sums over the episodes, and those over the steps."""
    features = np.asarray(expanded(basis, u))
    returns = means_of(paid, length) * (1 if form else length)
    return over_episodes(means_of(features, length), returns, length), over_steps(features, basis)


expanded = jax.jit(expand, static_argnums=0)


@jax.jit
def over_episodes(means, returns, length):
    return evidence.add_episodes(evidence.no_sums(means.shape[1]), means, returns, length)


@partial(jax.jit, static_argnums=1)
def over_steps(features, basis):
    return add_steps(no_steps(basis), features, jnp.ones(len(features), bool), basis)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("form", [0, 1])
def test_factors_that_tell_all(extended, form):
    """Two factors that vary alike: shares go as the squares of their weights."""
    basis = Basis(3, 2, extended)
    sums, of_steps = summed(basis, np.array([2.0, -1.0, 0, 0, 0]), form=form)
    found = explain(sums, of_steps, form, basis)
    steps = float(sums.steps / sums.episodes) if form else 1  # a step of an average has a T-th of it
    assert float(found.episodes) == 120
    assert bool(found.of_steps) == (form == 0)
    assert float(found.by_factors) > 0.98
    np.testing.assert_allclose(found.share, [0.8, 0.2, 0], atol=0.1)
    weight, deviation = np.asarray(found.slope) * steps, np.sqrt(np.diagonal(found.uncertainty)) * steps
    np.testing.assert_allclose(weight, [2, -1, 0], atol=0.15)
    assert (deviation > 0).all()
    assert (np.abs(weight - [2, -1, 0]) < 4 * deviation + 0.02).all()


def test_episodes_of_one_length_are_explained_by_their_returns():
    basis, random = Basis(2, 0, extended=False), np.random.default_rng(0)
    means, length = random.normal(size=(30, 2)), np.full(30, 7)
    given = (jnp.asarray(part) for part in (means, 7 * means @ [2.0, -1.0], length))
    assert not explain(evidence.add_episodes(evidence.no_sums(2), *given), no_steps(basis), 0, basis).of_steps


def test_what_the_factors_leave_goes_with_the_entry_that_is_missing():
    basis = Basis(2, 3, extended=True)
    found = explain(*summed(basis, np.array([1.0, 0, 0, -1.0, 0])), 0, basis)
    assert 0.3 < float(found.by_factors) < 0.7
    assert float(found.by_all) > 0.98
    left = np.asarray(found.left)
    assert left[1] < -0.9
    assert np.abs(left[[0, 2]]).max() < 0.4


def test_the_entries_share_what_a_fit_on_everything_explains():
    """Two entries that pay twice as much as the factor, by a line and by a pair with a third entry."""
    basis = Basis(1, 3, extended=True)
    found = explain(*summed(basis, lambda u: u[:, 0] + 2 * u[:, 1] + 2 * u[:, 2] * u[:, 3], noise=0.01), 0, basis)
    line, one, other = np.asarray(found.of_entries)
    assert float(found.by_all) > 0.98
    assert one == pytest.approx(other, abs=0.1)
    assert 0.5 < float(found.by_all) - float(found.by_factors) < 0.95
    assert line + one + other == pytest.approx(float(found.by_all) - float(found.by_factors), abs=0.1)
    assert min(line, one + other) > 0.2


def test_factors_that_tell_nothing():
    basis = Basis(2, 1, extended=False)
    found = explain(*summed(basis, np.array([0, 0, 1.0])), 0, basis)
    assert float(found.by_factors) < 0.1
    assert float(found.by_all) > 0.98


def test_without_factors_the_entries_tell():
    found = explain(*summed(Basis(0, 3, extended=False), np.array([1.0, 0, 0])), 0, Basis(0, 3, extended=False))
    assert (float(found.by_factors), found.share.shape, found.slope.shape) == (0, (0,), (0,))
    assert float(found.by_all) > 0.98
    np.testing.assert_allclose(found.of_entries, [found.by_all, 0, 0], atol=0.02)


def test_an_entry_that_never_varies_goes_with_nothing():
    basis = Basis(1, 2, extended=False)
    sums, steps = summed(basis, np.array([1.0, 1.0, 0]))
    products = sums.products.at[2, :].set(0).at[:, 2].set(0)
    assert float(explain(sums._replace(products=products), steps, 0, basis).left[1]) == 0


def test_a_factor_whose_mean_is_the_same_in_all_episodes_is_told_apart():
    """Although it varies within them, returns cannot tell what it pays. Rounding is no difference."""
    basis, random = Basis(2, 0, extended=False), np.random.default_rng(0)
    length = np.full(40, 8)
    u = random.normal(size=(320, 2))
    u[:, 1] = np.tile([1.0, 1, 1, -1, -1, -1, -1, 1], 40) + 1e-9 * u[:, 0]
    found = explain(*summed_over(basis, u, length, u @ [1.0, 1.0]), 0, basis)
    assert found.varied.tolist() == [True, False]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_of_few_episodes_nothing_is_said(count):
    basis = Basis(1, 1, extended=False)
    given = summed(basis, np.ones(2), count=count) if count else (evidence.no_sums(2), no_steps(basis))
    found = explain(*given, 0, basis)
    assert np.isnan(found.by_all)


@pytest.mark.parametrize("noise", [0.1, 3.0])
def test_the_shares_of_the_factors_add_up_to_what_they_explain(noise):
    basis = Basis(3, 2, extended=True)
    found = explain(*summed(basis, np.array([2.0, -1.0, 0.5, 1.0, 0]), count=30, noise=noise), 0, basis)
    assert 0 < float(found.by_factors) < 1
    assert float(found.share.sum()) == pytest.approx(float(found.by_factors))


def test_a_factor_that_offsets_another_has_a_share_below_0():
    """A cost that grows with the gain: its share is -Cov(cost, return) / Var(return), and that of the gain is above 1."""
    basis, random = Basis(2, 0, extended=False), np.random.default_rng(3)
    gain = random.normal(size=200)
    means = np.stack([gain, 0.8 * gain + 0.3 * random.normal(size=200)], axis=1)
    returns, length = means @ [2.0, -1.0], np.full(200, 20)
    sums = evidence.add_episodes(
        evidence.no_sums(2), jnp.asarray(means), jnp.asarray(20 * returns), jnp.asarray(length)
    )
    steps = add_steps(no_steps(basis), jnp.asarray(means), jnp.ones(200, bool), basis)
    found = explain(sums, steps, 0, basis)
    np.testing.assert_allclose(found.slope, [2, -1], rtol=1e-3)
    want = [
        weight * np.cov(column, returns)[0, 1] / returns.var(ddof=1)
        for weight, column in zip([2, -1], means.T, strict=True)
    ]
    assert want[1] < -0.3
    np.testing.assert_allclose(found.share, want, rtol=1e-2)


@pytest.mark.parametrize("count", [30, 100])
def test_the_slope_is_that_of_the_closest_line_whatever_features_express_it(count):
    """|u| bends the shapes of all factors, and a sine then takes the place of the second factor's line."""
    basis, (u, length) = Basis(2, 0, True), moody(2, count)
    effects = np.stack([-2 * np.abs(u[:, 0]), 0.5 * u[:, 1]], axis=1)
    found = explain(*summed_over(basis, u, length, effects.sum(axis=1)), 0, basis)
    lines = [np.polyfit(u[:, i], effects[:, i], 1) for i in range(2)]
    np.testing.assert_allclose(found.slope, [slope for slope, _ in lines], atol=0.05)
    assert float(found.linear[0]) < 0.1
    assert float(found.linear[1]) > 0.9
    np.testing.assert_allclose(found.paired, 0, atol=0.02)


@pytest.mark.parametrize("count", [30, 100])
def test_the_effect_of_a_rare_event_is_what_it_pays(count):
    """It has two values, so that all of its shapes are one line: weights are not known one by one, but what they add up to is."""
    random = np.random.default_rng(0)
    length = random.integers(20, 40, size=count)
    event = random.random(length.sum()) < 0.03
    deviation = event.std()
    u = np.stack([(event - event.mean()) / deviation, random.normal(size=len(event))], axis=1)
    basis = Basis(2, 0, extended=True)
    found = explain(*summed_over(basis, u, length, 5.0 * event + 0.01 * random.normal(size=len(event))), 0, basis)
    assert float(found.slope[0]) == pytest.approx(5 * deviation, rel=0.02)
    assert float(found.uncertainty[0, 0]) < 0.02**2
    assert float(found.linear[0]) == pytest.approx(1, abs=1e-3)


def test_the_effect_of_a_pair_is_told_apart():
    basis = Basis(2, 0, True)
    found = explain(*summed(basis, lambda u: u[:, 0] * u[:, 1], 100), 0, basis)
    np.testing.assert_allclose(found.paired, found.share, atol=0.1)
    np.testing.assert_allclose(found.slope, 0, atol=0.1)
