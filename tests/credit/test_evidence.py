"""The evidence's fixed point against plain NumPy, and what it promises: on synthetic episodes whose true rewards are known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.credit import evidence
from lare_rl.credit.basis import Basis, expand

GROUP = np.repeat([0, 1, 2], [3, 4, 5])


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


def episodes(count=40, noise=0.1, seed=0, lengths=(5, 30)):
    """Means of features, returns and lengths of episodes; only the first group and a feature of the last one pay."""
    random = np.random.default_rng(seed)
    length = random.integers(*lengths, size=count)
    weight = np.zeros(len(GROUP))
    weight[:3], weight[7] = [1.0, -2.0, 0.5], 1.5
    mood = random.normal(size=(count, len(GROUP)))  # of an episode: without one, the means of long ones are all alike
    steps = [one + random.normal(size=(T, len(GROUP))) for one, T in zip(mood, length, strict=True)]
    returns = np.array([(rows @ weight + 0.7 + noise * random.normal(size=len(rows))).sum() for rows in steps])
    return np.array([rows.mean(axis=0) for rows in steps]), returns, length, weight


def summed(means, returns, length, pieces=1):
    sums = evidence.no_sums(means.shape[1])
    for piece in np.array_split(np.arange(len(means)), pieces):
        sums = add_episodes(sums, *(part[piece] for part in (means, returns, length)))
    return sums


add_episodes = jax.jit(evidence.add_episodes)


@partial(jax.jit, static_argnames=("form", "group", "rounds"))
def fitted(sums, form, group, rounds, start):
    return evidence.fit(sums, form, np.array(group), start, rounds)


def fit(sums, form=0, group=GROUP, rounds=100):
    start = evidence.unknown(len(group), int(group.max()) + 1)
    return fitted(sums, form, tuple(group.tolist()), rounds, start)


def slowly(means, y, length, group, rounds, shares, noise):
    """The fixed point as the equations stand, with matrices inverted.

    It starts where each group explains so many equal shares of half of the variance, and the noise explains `noise` of it.
    """
    mean, centre = np.average(means, axis=0, weights=length), np.average(y, weights=length)
    x, left = means - mean, y - centre
    unit = np.sqrt(np.average(left**2, weights=length))
    s, p, q = (length * x.T) @ x, (length * x.T) @ left / unit, (length * left**2).sum() / unit**2
    groups, free = group.max() + 1, len(y) - 1
    alpha = np.array([2 * groups * np.trace(s[np.ix_(group == g, group == g)]) / q for g in range(groups)]) / shares
    beta = free / (noise * q)
    for _ in range(rounds):
        sigma = np.linalg.inv(beta * s + np.diag(alpha[group]))
        mu = beta * sigma @ p
        gamma = np.array(
            [(group == g).sum() - alpha[g] * np.trace(sigma[np.ix_(group == g, group == g)]) for g in range(groups)]
        )
        rss = q - 2 * mu @ p + mu @ s @ mu
        logs = free * np.log(beta) + np.log(alpha[group]).sum() + np.linalg.slogdet(sigma)[1]
        log_evidence = 0.5 * (logs - beta * rss - alpha[group] @ mu**2)
        alpha = gamma / np.array([(mu[group == g] ** 2).sum() for g in range(groups)])
        beta = (free - gamma.sum()) / rss
    return unit * mu, centre - unit * mu @ mean, alpha, beta, gamma, log_evidence


@pytest.mark.parametrize("pieces", [1, 7])
def test_sums_against_numpy(pieces):
    means, returns, length, _ = episodes()
    means[:, 0] += 1e3  # and without cancellation
    sums = summed(means, returns, length, pieces)
    v = np.column_stack([means, returns / length, returns])
    mean = np.average(v, axis=0, weights=length)
    assert (float(sums.episodes), float(sums.steps)) == (len(v), length.sum())
    np.testing.assert_allclose(sums.mean, mean)
    np.testing.assert_allclose(sums.products, (length * (v - mean).T) @ (v - mean), rtol=1e-8, atol=1e-8)


def test_places_without_an_episode_count_for_nothing():
    means, returns, length, _ = episodes()
    length[::3] = 0
    there = length > 0
    one, other = summed(means, returns, length, 2), summed(means[there], returns[there], length[there])
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("form", [0, 1])
@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_the_fixed_point_against_numpy(rounds, form):
    means, returns, length, _ = episodes(count=60)
    y = returns if form else returns / length
    starts = (np.ones(3), 0.5), (np.array([100, 1e-4, 1e-4]), 1e-6)
    of_each = [slowly(means, y, length, GROUP, rounds, *start) for start in starts]
    weight, bias, alpha, beta, gamma, log_evidence = max(of_each, key=lambda one: one[-1])
    found = fit(summed(means, returns, length), form, rounds=rounds)
    np.testing.assert_allclose(found.weight, weight, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(found.bias, bias, rtol=1e-5)
    np.testing.assert_allclose(found.alpha, alpha, rtol=1e-4)
    np.testing.assert_allclose(found.beta, beta, rtol=1e-4)
    np.testing.assert_allclose(found.determined, gamma, rtol=1e-4)
    np.testing.assert_allclose(found.log_evidence, log_evidence, rtol=1e-5)


def test_without_noise_the_rewards_are_found():
    means, returns, length, weight = episodes(count=200, noise=0.0)
    found = fit(summed(means, returns, length))
    np.testing.assert_allclose(found.weight, weight, atol=1e-4)
    assert float(found.bias) == pytest.approx(0.7, abs=1e-4)


def rare(count, seed):
    """Episodes with an event at their last step alone, which is worth more than all else. Without noise, it is known at once."""
    random = np.random.default_rng(seed)
    length = np.where(random.random(count) < 0.3, random.integers(40, 60, count), 60)
    means = random.normal(size=(count, 30)) * np.append([0.004, 0.5, 0.3, 0.05], np.full(26, 0.3))
    means[:, 0] = 1 / length / 0.13
    return means, (13 * means[:, 0] + 0.14 * means[:, 1] + 0.1 * means[:, 2]) * length, length


@pytest.mark.parametrize("seed", range(5))
def test_a_rare_event_is_found_at_once_where_there_is_no_noise(seed):
    """From equal shares alone, the fit takes most of the variation for noise until episodes are twice as many as features."""
    group = np.repeat([0, 1], [4, 26])
    means, returns, length = rare(10, seed)
    found = fit(summed(means, returns, length), group=group)
    unseen, told, steps = rare(200, seed + 100)
    np.testing.assert_allclose(steps * (unseen @ np.asarray(found.weight) + float(found.bias)), told, atol=1.0)


def test_a_group_that_does_not_help_is_switched_off():
    means, returns, length, _ = episodes(count=100)
    found = fit(summed(means, returns, length))
    gamma = np.asarray(found.determined)
    assert gamma[0] > 2.9
    assert gamma[1] < 0.5
    assert np.abs(found.weight[3:7]).max() < 0.01


@pytest.mark.parametrize("count", [0, 1])
def test_of_fewer_than_two_episodes_only_the_mean_is_known(count):
    means, returns, length, _ = episodes(count=5)
    found = fit(summed(means[:count], returns[:count], length[:count]))
    assert not np.asarray(found.weight).any()
    assert float(found.bias) == pytest.approx(returns[0] / length[0] if count else 0)


def test_returns_that_never_vary_say_nothing():
    means, _, length, _ = episodes()
    found = fit(summed(means, 0.3 * length, length))
    assert np.abs(found.weight).max() < 1e-6
    assert float(found.bias) == pytest.approx(0.3)


def test_a_later_fit_goes_on_where_the_earlier_one_ended():
    means, returns, length, _ = episodes()
    sums = summed(means, returns, length)
    known = evidence.unknown(len(GROUP), 3)
    for _ in range(5):
        known = fitted(sums, 0, tuple(GROUP.tolist()), 20, known)
    for a, b in zip(known, fit(sums, rounds=100), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [4, 6, 12, 18])
@pytest.mark.parametrize("share_of_noise", [1e-9, 0.999])
def test_a_fit_leaves_a_maximum_in_which_the_earlier_one_was_caught(share_of_noise, count):
    """Nothing was noise to the earlier fit, or everything was. The later one is no worse than one from the beginning."""
    means, returns, length, _ = episodes(count=count, noise=0.3)
    sums = summed(means, returns, length)
    afresh = fit(sums)
    given = evidence.problem(sums, 0, GROUP)
    caught = afresh._replace(
        alpha=given.equal * (1e4 if share_of_noise > 0.5 else 1e-4), beta=given.free / given.q / share_of_noise
    )
    found = fitted(sums, 0, tuple(GROUP.tolist()), 100, caught)
    assert float(found.log_evidence) >= float(afresh.log_evidence) - 0.01


@pytest.mark.parametrize("seed", range(3))
def test_the_deviation_is_as_large_as_the_error(seed):
    """Of all features, two deviations cover nineteen of twenty errors, about; and more episodes make them smaller."""
    widths = []
    for count in (30, 300):
        means, returns, length, weight = episodes(count=count, noise=1.0, seed=seed)
        sums = summed(means, returns, length)
        found = fit(sums)
        rows = np.random.default_rng(9).normal(size=(2000, len(GROUP)))
        known = np.asarray(evidence.deviation(evidence.spread(sums, 0, GROUP, found), jnp.asarray(rows)))
        away = np.abs(rows @ (np.asarray(found.weight) - weight) + float(found.bias) - 0.7)
        assert (away <= 2 * known).mean() > 0.8
        assert away.mean() > 0.2 * known.mean()
        widths.append(known.mean())
    assert widths[1] < widths[0] / 2


def test_the_covariance_is_the_inverse_of_the_precision():
    means, returns, length, _ = episodes()
    sums = summed(means, returns, length)
    found = fit(sums)
    unit = np.sqrt(float(sums.products[-2, -2] / sums.steps))
    precision = float(found.beta) * np.asarray(sums.products[:-2, :-2]) + np.diag(np.asarray(found.alpha)[GROUP])
    got = np.asarray(evidence.covariance(sums, 0, GROUP, found))
    np.testing.assert_allclose(got, unit**2 * np.linalg.inv(precision), rtol=1e-5, atol=1e-12)


# Never worse than what it is given: on episodes whose true rewards are known.


def synthetic(seed, count, noise, longest, phi):
    """Steps of episodes: features in two groups, `phi` and eight raw ones of which the reward is made, and the true rewards."""
    random = np.random.default_rng(seed)
    length = random.integers(max(2, longest // 3), longest + 1, size=count + 20)
    mood = random.normal(size=(len(length), 8))
    raw = [one + random.normal(size=(T, 8)) for one, T in zip(mood, length, strict=True)]
    weight = np.array([1.0, -0.7, 0.5, 0, 0, 0, 0, 0])
    reward = [rows @ weight + 0.3 for rows in raw]
    if phi == "perfect":
        factors = [rows[:, :3] for rows in raw]
    elif phi == "correlated":
        factors = [rows[:, :3] @ np.array([[1, 1, 0], [0, 0.05, 0], [0, 0, 1.0]]) for rows in raw]
    elif phi == "duplicated":
        factors = [rows[:, [0, 1, 2, 0, 1]] for rows in raw]
    elif phi == "constant":
        factors = [np.column_stack([rows[:, :3], np.zeros(len(rows))]) for rows in raw]
    else:
        factors = [random.normal(size=(len(rows), 3)) + random.normal(size=3) for rows in raw]
    returns = np.array([one.sum() + noise * np.sqrt(len(one)) * random.normal() for one in reward])
    return factors, raw, reward, returns, length


def error_of(features, group, reward, returns, length, count):
    """Mean error of r_hat, over deviation of the rewards, of episodes that the fit has not seen."""
    means = np.array([rows.mean(axis=0) for rows in features[:count]])
    found = fit(summed(means, returns[:count], length[:count]), group=group, rounds=60)
    rows, true = np.concatenate(features[count:]), np.concatenate(reward[count:])
    assert np.isfinite(np.asarray(found.weight)).all()
    return np.abs(rows @ np.asarray(found.weight) + float(found.bias) - true).mean() / true.std()


def compared(seed, count, noise, longest, phi):
    factors, raw, *rest = synthetic(seed, count, noise, longest, phi)
    d = factors[0].shape[1]
    both = [np.column_stack(pair) for pair in zip(factors, raw, strict=True)]
    return (
        error_of(factors, np.zeros(d, int), *rest, count),
        error_of(raw, np.zeros(8, int), *rest, count),
        error_of(both, np.repeat([0, 1], [d, 8]), *rest, count),
    )


def over(counts, noises):
    """Any seed, short episodes and long ones, with some numbers of episodes and sizes of the noise."""
    drawn = given(
        seed=st.integers(0, 10_000),
        count=st.sampled_from(counts),
        noise=st.sampled_from(noises),
        longest=st.sampled_from([5, 40]),
    )
    return lambda test: settings(max_examples=12, deadline=None, derandomize=True)(drawn(test))


@pytest.mark.parametrize("phi", ["perfect", "correlated", "duplicated", "constant"])
@over([12, 25, 60], [0.0, 0.3, 1.0])
def test_beside_a_good_phi_raw_features_cost_nothing(phi, seed, count, noise, longest):
    with jax.enable_x64(True):
        of_phi, _, of_both = compared(seed, count, noise, longest, phi)
    assert of_both <= of_phi + 0.15 + 2.0 / count


@over([15, 30, 80], [0.0, 0.3])
def test_an_irrelevant_phi_is_as_good_as_none(seed, count, noise, longest):
    with jax.enable_x64(True):
        of_phi, of_raw, of_both = compared(seed, count, noise, longest, "irrelevant")
    assert of_both <= of_raw + 0.1 + 2.0 / count
    assert of_both < of_phi


@over([12, 25, 60], [0.0, 0.3])
def test_pairs_cost_nothing_where_the_score_has_no_product(seed, count, noise, longest):
    basis = Basis(0, 8, extended=True)
    _, raw, *rest = synthetic(seed, count, noise, longest, "perfect")
    deviation = np.concatenate(raw[:count]).std(axis=0)
    together = np.asarray(jax.jit(expand, static_argnums=0)(basis, np.concatenate(raw) / deviation), float)
    features = np.split(together, np.cumsum([len(rows) for rows in raw])[:-1])
    additive = basis.group < basis.group.max()
    with jax.enable_x64(True):
        without = error_of([rows[:, additive] for rows in features], basis.group[additive], *rest, count)
        with_pairs = error_of(features, basis.group, *rest, count)
    assert list(basis.sizes)[-1] == "pairs of entries"
    assert with_pairs <= without + 0.1 + 2.0 / count
