from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.credit import evidence

pytestmark = pytest.mark.usefixtures("in_float64")

GROUP_INDEX = np.repeat([0, 1, 2], [3, 4, 5])
MAX_EPISODES = 320
add_episodes = jax.jit(evidence.add_episodes)


def sample_episodes(count=40, noise=0.1, seed=0):
    """Return mean features, returns and lengths of episodes, and the weights. The weights of two of the groups are zero but one."""
    random = np.random.default_rng(seed)
    length = random.integers(5, 30, size=count)
    weight = np.zeros(len(GROUP_INDEX))
    weight[:3], weight[7] = [1.0, -2.0, 0.5], 1.5
    episode_mean = random.normal(size=(count, len(GROUP_INDEX)))  # without it, long episodes would have equal means
    steps = [mean + random.normal(size=(T, len(GROUP_INDEX))) for mean, T in zip(episode_mean, length, strict=True)]
    returns = np.array([(rows @ weight + 0.7 + noise * random.normal(size=len(rows))).sum() for rows in steps])
    return np.array([rows.mean(axis=0) for rows in steps]), returns, length, weight


def sum_up(*episodes, n_chunks=1):
    """Return the statistics of mean features, returns and lengths. Padding, which is NaN, lets all calls have the same shapes."""
    statistics = evidence.empty_statistics(episodes[0].shape[1])
    for chunk in np.array_split(np.arange(len(episodes[0])), n_chunks):
        padding = (0, MAX_EPISODES - len(chunk))
        means, episode_returns, length = (np.pad(v[chunk], (padding, (0, 0))[: v.ndim]) for v in episodes)
        means[len(chunk) :] = episode_returns[len(chunk) :] = np.nan
        statistics = add_episodes(statistics, means, episode_returns, length)
    return statistics


def sample_sums(**options):
    return sum_up(*sample_episodes(**options)[:3])


@partial(jax.jit, static_argnames="group_index")
def fit_from(start, statistics, score_type=0, group_index=tuple(GROUP_INDEX), max_rounds=100):
    return evidence.fit(statistics, score_type, np.array(group_index), start, max_rounds)


def fit(statistics, score_type=0, group_index=GROUP_INDEX, max_rounds=100):
    start = evidence.init_posterior(group_index)
    return fit_from(start, statistics, score_type, tuple(group_index), max_rounds)


def numpy_fit(means, y, length, max_rounds, shares, noise):
    """Iterate the equations as they are written, with inverse matrices.

    Each group starts from a number of equal shares of half of the variance, and the noise from a fraction of the variance.
    """
    group, n_groups = GROUP_INDEX, GROUP_INDEX.max() + 1
    x_mean, y_mean = np.average(means, axis=0, weights=length), np.average(y, weights=length)
    x, y_std = means - x_mean, np.sqrt(np.average((y - y_mean) ** 2, weights=length))
    y = (y - y_mean) / y_std
    s, p, q = (length * x.T) @ x, (length * x.T) @ y, (length * y**2).sum()

    def group_trace(matrix):
        return np.array([np.trace(matrix[np.ix_(group == g, group == g)]) for g in range(n_groups)])

    alpha, beta = 2 * n_groups * group_trace(s) / q / shares, (len(y) - 1) / (noise * q)
    for _ in range(max_rounds):
        sigma = np.linalg.inv(beta * s + np.diag(alpha[group]))
        mu = beta * sigma @ p
        gamma = np.bincount(group) - alpha * group_trace(sigma)
        residual = q - 2 * mu @ p + mu @ s @ mu
        logs = (len(y) - 1) * np.log(beta) + np.log(alpha[group]).sum() + np.linalg.slogdet(sigma)[1]
        log_evidence = 0.5 * (logs - beta * residual - alpha[group] @ mu**2)
        alpha = gamma / np.bincount(group, mu**2)
        beta = (len(y) - 1 - gamma.sum()) / residual
    return y_std * mu, y_mean - y_std * mu @ x_mean, alpha, beta, gamma, log_evidence


def test_add_episodes_against_numpy():
    means, returns, length, _ = sample_episodes()
    means[:, 0] += 1e3  # there is no cancellation
    length[::3] = 0  # padding
    statistics = sum_up(means, returns, length, n_chunks=7)
    means, returns, length = (values[length > 0] for values in (means, returns, length))
    v = np.column_stack([means, returns / length, returns])
    mean = np.average(v, axis=0, weights=length)
    assert (float(statistics.n_episodes), float(statistics.n_steps)) == (len(v), length.sum())
    np.testing.assert_allclose(statistics.mean, mean)
    np.testing.assert_allclose(statistics.products, (length * (v - mean).T) @ (v - mean), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("score_type", [0, 1])
def test_fit_against_numpy(score_type):
    means, returns, length, _ = sample_episodes(count=60)
    y = returns if score_type else returns / length
    starts = (np.ones(3), 0.5), (np.array([100, 1e-4, 1e-4]), 1e-6)
    for max_rounds in (1, 2, 3):
        candidates = [numpy_fit(means, y, length, max_rounds, *start) for start in starts]
        posterior = fit(sum_up(means, returns, length), score_type, max_rounds=max_rounds)
        for value, want in zip(posterior, max(candidates, key=lambda candidate: candidate[-1]), strict=True):
            np.testing.assert_allclose(value, want, rtol=1e-4, atol=1e-8)


def test_fit_recovers_rewards_where_returns_determine_them():
    means, returns, length, weight = sample_episodes(count=200, noise=0.0)
    posterior = fit(sum_up(means, returns, length))
    np.testing.assert_allclose(posterior.weight, weight, atol=1e-4)
    assert float(posterior.bias) == pytest.approx(0.7, abs=1e-4)
    noisy = fit(sample_sums(count=100))
    assert noisy.n_effective[0] > 2.9
    assert noisy.n_effective[1] < 0.5
    assert np.abs(noisy.weight[3:7]).max() < 0.01  # the useless group is switched off
    means, returns, length, _ = sample_episodes()
    equal = fit(sum_up(means, 0.3 * length, length))
    assert np.abs(equal.weight).max() < 1e-6
    assert float(equal.bias) == pytest.approx(0.3)
    for count, bias in ((0, 0), (1, returns[0] / length[0])):
        posterior = fit(sum_up(means[:count], returns[:count], length[:count]))
        assert not np.asarray(posterior.weight).any()
        assert float(posterior.bias) == pytest.approx(bias)


def test_fit_recovers_a_rare_event_from_few_episodes():
    """From equal shares alone, a fit would take most of the variation as noise until episodes outnumber features twice."""

    def sample(count, seed):
        random = np.random.default_rng(seed)
        length = np.where(random.random(count) < 0.3, random.integers(40, 60, count), 60)
        means = random.normal(size=(count, 30)) * np.append([0.004, 0.5, 0.3, 0.05], np.full(26, 0.3))
        means[:, 0] = 1 / length / 0.13  # an event at the last step, which is worth more than all else
        return means, (13 * means[:, 0] + 0.14 * means[:, 1] + 0.1 * means[:, 2]) * length, length

    for seed in range(5):
        posterior = fit(sum_up(*sample(10, seed)), group_index=np.repeat([0, 1], [4, 26]))
        means, returns, length = sample(200, seed + 100)
        predicted = length * (means @ np.asarray(posterior.weight) + float(posterior.bias))
        np.testing.assert_allclose(predicted, returns, atol=1.0)


@pytest.mark.parametrize("error", [0.0, 1e-18, 1e-9])
def test_rounding_errors_of_a_constant_have_no_weight(error):
    """Even if they happen to follow the returns. The time has a constant mean if all episodes are equally long."""
    means, returns, length, _ = sample_episodes(noise=2.0)
    means[:, 8] = 0.3 + error * returns / length  # only what follows of this can be stored in the sums
    statistics = sum_up(means, returns, length)
    exact = error**2 * statistics.products[-2, -2]
    row = error * statistics.products[-2, :].at[8].set(error * statistics.products[-2, -2])
    statistics = statistics._replace(products=statistics.products.at[8].set(row).at[:, 8].set(row).at[8, 8].set(exact))
    separate = fit(statistics, group_index=np.arange(len(GROUP_INDEX)))
    without = fit(statistics._replace(products=statistics.products.at[8].set(0).at[:, 8].set(0)))
    assert separate.weight[8] == 0
    np.testing.assert_allclose(fit(statistics).weight, without.weight, rtol=1e-9)


def test_fit_continues_from_an_earlier_one():
    statistics = sample_sums()
    posterior = evidence.init_posterior(GROUP_INDEX)
    for _ in range(5):
        posterior = fit_from(posterior, statistics, max_rounds=20)
    for a, b in zip(posterior, fit(statistics), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [4, 6, 12, 18])
def test_fit_leaves_a_poor_maximum(count):
    """The earlier fit took nothing as noise, or all variation. The later one is no worse than without it."""
    statistics = sample_sums(count=count, noise=0.3)
    fresh, problem = fit(statistics), evidence.regression(statistics, 0, GROUP_INDEX)
    for noise_share, scale in ((1e-9, 1e-4), (0.999, 1e4)):
        start = fresh._replace(alpha=problem.equal_alpha * scale, beta=problem.dof / problem.q / noise_share)
        assert float(fit_from(start, statistics).log_evidence) >= float(fresh.log_evidence) - 0.01


def test_posterior_std():
    """The covariance is the inverse of the precision. Two standard deviations cover most errors; more episodes make them smaller."""
    statistics = sample_sums()
    posterior = fit(statistics)
    precision = posterior.beta * statistics.products[:-2, :-2] + np.diag(posterior.alpha[GROUP_INDEX])
    covariance = evidence.posterior_covariance(statistics, 0, GROUP_INDEX, posterior)
    variance = statistics.products[-2, -2] / statistics.n_steps
    np.testing.assert_allclose(
        covariance.root.T @ covariance.root, variance * np.linalg.inv(precision), rtol=1e-5, atol=1e-12
    )
    centre_std = evidence.posterior_std(covariance, statistics.mean[:-2])
    assert float(centre_std**2) == pytest.approx(float(variance / (posterior.beta * statistics.n_steps)))
    rows = np.random.default_rng(9).normal(size=(2000, len(GROUP_INDEX)))
    for seed in range(3):
        stds = []
        for count in (30, 300):
            means, returns, length, weight = sample_episodes(count=count, noise=1.0, seed=seed)
            statistics = sum_up(means, returns, length)
            posterior = fit(statistics)
            covariance = evidence.posterior_covariance(statistics, 0, GROUP_INDEX, posterior)
            std = np.asarray(evidence.posterior_std(covariance, jnp.asarray(rows)))
            error = np.abs(rows @ (np.asarray(posterior.weight) - weight) + float(posterior.bias) - 0.7)
            assert (error <= 2 * std).mean() > 0.8
            assert error.mean() > 0.2 * std.mean()
            stds.append(std.mean())
        assert stds[1] < stds[0] / 2


FACTORS = {
    "perfect": lambda raw, _: raw[:, :3],
    "correlated": lambda raw, _: raw[:, :3] @ np.array([[1, 1, 0], [0, 0.05, 0], [0, 0, 1.0]]),
    "duplicated": lambda raw, _: raw[:, [0, 1, 2, 0, 1]],
    "constant": lambda raw, _: np.column_stack([raw[:, :3], np.zeros(len(raw))]),
    "irrelevant": lambda raw, random: random.normal(size=(len(raw), 3)) + random.normal(size=3),
}


def synthetic_episodes(seed, count, noise, max_steps, phi):
    """Return factors and raw features of steps, their rewards (linear in the raw features), returns and lengths."""
    random = np.random.default_rng(seed)
    length = random.integers(max(2, max_steps // 3), max_steps + 1, size=count + 20)
    episode_mean = random.normal(size=(len(length), 8))
    raw = [mean + random.normal(size=(T, 8)) for mean, T in zip(episode_mean, length, strict=True)]
    reward = [rows @ np.array([1.0, -0.7, 0.5, 0, 0, 0, 0, 0]) + 0.3 for rows in raw]
    factors = [FACTORS[phi](rows, random) for rows in raw]
    factors = [np.pad(rows, ((0, 0), (0, 5 - rows.shape[1]))) for rows in factors]  # constants change nothing
    returns = np.array([r.sum() + noise * np.sqrt(len(r)) * random.normal() for r in reward])
    return factors, raw, reward, returns, length


def unseen_error(features, group_sizes, reward, returns, length, count):
    """Return the mean error of r_hat on later episodes, relative to the standard deviation of the rewards."""
    means = np.array([rows.mean(axis=0) for rows in features[:count]])
    group_index = np.repeat(np.arange(len(group_sizes)), group_sizes)
    posterior = fit(sum_up(means, returns[:count], length[:count]), group_index=group_index, max_rounds=60)
    rows, true = np.concatenate(features[count:]), np.concatenate(reward[count:])
    assert np.isfinite(np.asarray(posterior.weight)).all()
    return np.abs(rows @ np.asarray(posterior.weight) + float(posterior.bias) - true).mean() / true.std()


def compare_features(seed, count, noise, max_steps, phi):
    """Return the errors of fits on factors, on raw features, and on both."""
    factors, raw, *rest = synthetic_episodes(seed, count, noise, max_steps, phi)
    n_factors = factors[0].shape[1]
    both = [np.column_stack(pair) for pair in zip(factors, raw, strict=True)]
    sizes = ((factors, [n_factors]), (raw, [8]), (both, [n_factors, 8]))
    with jax.enable_x64(True):
        return [unseen_error(features, group_sizes, *rest, count) for features, group_sizes in sizes]


def sampled(counts, noises):
    """Run a test with any seed, and short or long episodes."""
    arguments = given(
        seed=st.integers(0, 10_000),
        count=st.sampled_from(counts),
        noise=st.sampled_from(noises),
        max_steps=st.sampled_from([5, 40]),
    )
    return lambda test: settings(max_examples=12, deadline=None, derandomize=True)(arguments(test))


@pytest.mark.parametrize("phi", ["perfect", "correlated", "duplicated", "constant"])
@sampled([12, 25, 60], [0.0, 0.3, 1.0])
def test_raw_features_do_not_harm_good_factors(phi, seed, count, noise, max_steps):
    factors_error, _, both_error = compare_features(seed, count, noise, max_steps, phi)
    assert both_error <= factors_error + 0.15 + 2.0 / count


@sampled([15, 30, 80], [0.0, 0.3])
def test_irrelevant_factors_do_not_harm(seed, count, noise, max_steps):
    factors_error, raw_error, both_error = compare_features(seed, count, noise, max_steps, "irrelevant")
    assert both_error <= raw_error + 0.1 + 2.0 / count
    assert both_error < factors_error


def test_split_double():
    numbers = jnp.asarray(1e6 + np.random.default_rng(0).normal(size=10))
    statistics = evidence.empty_statistics(8)._replace(mean=numbers)
    stored = evidence.split_double(statistics)
    assert {leaf.dtype for leaf in stored} == {np.dtype(np.float32)}
    np.testing.assert_allclose(evidence.to_float64(stored).mean, numbers, rtol=1e-14)
    # On a GPU, XLA may leave out a conversion to float32 and back, but not this operation.
    assert "reduce_precision" in str(jax.make_jaxpr(evidence.split_double)(statistics))
