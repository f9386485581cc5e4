import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import accuracy


def test_against_numpy():
    rng = np.random.default_rng(0)
    reward, noise = rng.normal(size=(2, 50)).astype(np.float32)
    r_hat, mask = 2 * reward + noise, np.arange(50) < 40
    error = accuracy.mean_error(jnp.asarray(r_hat), jnp.asarray(reward), jnp.asarray(mask))
    correlation = accuracy.correlation(jnp.asarray(r_hat), jnp.asarray(reward), jnp.asarray(mask))
    assert float(error) == pytest.approx(np.abs(r_hat - reward)[:40].mean(), rel=1e-5)
    assert float(correlation) == pytest.approx(np.corrcoef(r_hat[:40], reward[:40])[0, 1], rel=1e-4)


def test_correlation_with_a_constant_is_not_a_number():
    assert np.isnan(float(accuracy.correlation(jnp.arange(5.0), jnp.ones(5), jnp.ones(5, bool))))
