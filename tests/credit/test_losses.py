import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import losses


def test_sum_form_and_unbiased_error():
    mean, returns, length = jnp.array([0.5, -1.0]), jnp.array([4.0, 3.0]), jnp.array([4, 2])
    weight = losses.episode_weight(length, jnp.ones(2), sum_form=True)
    loss = losses.squared_error(mean, returns / length, weight)
    assert float(loss) == pytest.approx(((0.5 * 4 - 4) ** 2 + (-1.0 * 2 - 3) ** 2) / 2)
    np.testing.assert_array_equal(losses.episode_weight(length, jnp.array([1.0, 0.0]), sum_form=False), [1, 0])
    rng = np.random.default_rng(0)
    length, k, samples = 12, 5, 40_000
    r_hat, mean_reward = rng.normal(size=length), 0.3
    rows = rng.permuted(np.tile(np.float32(r_hat), (samples, 1)), axis=1)[:, :k]
    mean, target, weight = jnp.asarray(rows.mean(axis=1)), jnp.full(samples, mean_reward), jnp.ones(samples)
    variance = losses.subsampling_variance(jnp.asarray(rows), jnp.full(samples, length))
    biased = float(losses.squared_error(mean, target, weight))
    unbiased = float(losses.unbiased_squared_error(mean, target, weight, variance))
    full = (r_hat.mean() - mean_reward) ** 2
    bias = r_hat.var(ddof=1) * (1 - k / length) / k
    assert unbiased == pytest.approx(full, abs=0.01)
    assert biased == pytest.approx(full + bias, abs=0.01)
    assert bias > 0.05


# K = 4. The sample variance of 1, 2, 3, 4 is 5/3. Reacher has T < K, where the published coefficient is negative.
@pytest.mark.parametrize(("length", "want"), [(8, 5 / 3 * 0.5 / 4), (4, 0.0), (3, 0.0), (1, 0.0)])
def test_subsampling_variance_pinned(length, want):
    variance = jax.jit(losses.subsampling_variance)(jnp.array([[1.0, 2.0, 3.0, 4.0]]), jnp.array([length]))
    np.testing.assert_allclose(variance, [want], rtol=1e-6)
