"""The equations against pinned numbers and a slow NumPy twin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import losses


def test_episode_means_ignore_padding():
    r_hat = jnp.array([1.0, 2.0, 3.0, 10.0, 20.0, 99.0])
    episode_index = jnp.array([0, 0, 0, 1, 1, 2])  # the last row is padding
    means = jax.jit(losses.episode_means)(r_hat, episode_index, jnp.array([3, 2]))
    np.testing.assert_allclose(means, [2.0, 15.0])


@pytest.mark.parametrize(
    ("mean", "target", "weight", "want"),
    [
        ([1.0, 4.0], [0.0, 2.0], [1.0, 1.0], (1 + 4) / 2),
        ([1.0, 7.0], [0.0, 2.0], [1.0, 0.0], 1.0),
        ([1.0, 1.0], [0.0, 0.0], [0.0, 0.0], 0.0),
    ],
)
def test_squared_error_pinned(mean, target, weight, want):
    assert float(losses.squared_error(*map(jnp.array, (mean, target, weight)))) == pytest.approx(want)


def test_sum_form_is_the_squared_error_of_sums():
    mean, returns, length = jnp.array([0.5, -1.0]), jnp.array([4.0, 3.0]), jnp.array([4, 2])
    weight = losses.episode_weight(length, jnp.ones(2), sum_form=True)
    loss = losses.squared_error(mean, returns / length, weight)
    assert float(loss) == pytest.approx(((0.5 * 4 - 4) ** 2 + (-1.0 * 2 - 3) ** 2) / 2)
    np.testing.assert_array_equal(losses.episode_weight(length, jnp.array([1.0, 0.0]), sum_form=False), [1, 0])


# K = 4. The sample variance of 1, 2, 3, 4 is 5/3. Reacher has T < K, where the published coefficient is negative.
@pytest.mark.parametrize(("length", "want"), [(8, 5 / 3 * 0.5 / 4), (4, 0.0), (3, 0.0), (1, 0.0)])
def test_subsampling_variance_pinned(length, want):
    variance = jax.jit(losses.subsampling_variance)(jnp.array([[1.0, 2.0, 3.0, 4.0]]), jnp.array([length]))
    np.testing.assert_allclose(variance, [want], rtol=1e-6)


def test_leave_one_out_likelihood_pinned():
    """With a deviation of 2 at every step: e^2 / 8 + log 2. The second episode does not count."""
    mean, target, weight = jnp.array([1.0, 9.0]), jnp.array([0.0, 2.0]), jnp.array([1.0, 0.0])
    loss = losses.leave_one_out_likelihood(mean, target, weight, jnp.full(2, 0.25), jnp.full(2, jnp.log(2.0)))
    assert float(loss) == pytest.approx(1 / 8 + np.log(2))


def test_unbiased_squared_error_has_the_expectation_of_the_full_one():
    rng = np.random.default_rng(0)
    length, k, samples = 12, 5, 40_000
    r_hat, mean_reward = rng.normal(size=length), 0.3
    rows = np.stack([rng.choice(r_hat, k, replace=False) for _ in range(samples)]).astype(np.float32)
    mean, target, weight = jnp.asarray(rows.mean(axis=1)), jnp.full(samples, mean_reward), jnp.ones(samples)
    variance = losses.subsampling_variance(jnp.asarray(rows), jnp.full(samples, length))
    biased = float(losses.squared_error(mean, target, weight))
    unbiased = float(losses.unbiased_squared_error(mean, target, weight, variance))
    full = (r_hat.mean() - mean_reward) ** 2
    bias = r_hat.var(ddof=1) * (1 - k / length) / k
    assert unbiased == pytest.approx(full, abs=0.01)
    assert biased == pytest.approx(full + bias, abs=0.01)
    assert bias > 0.05
