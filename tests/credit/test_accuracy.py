import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import accuracy


def test_metrics_against_numpy():
    rng = np.random.default_rng(0)
    reward, noise = rng.normal(size=(2, 50)).astype(np.float32)
    r_hat, mask, last = 2 * reward + noise, np.arange(50) < 40, np.arange(50) % 10 == 9
    args = [jnp.asarray(values) for values in (r_hat, reward, last, mask)]
    metrics = accuracy.metrics(*args, calibrated=True)
    assert float(metrics["credit/error"]) == pytest.approx(np.abs(r_hat - reward)[:40].mean(), rel=1e-5)
    want = np.corrcoef(r_hat[:40], reward[:40])[0, 1]
    assert float(metrics["credit/correlation"]) == pytest.approx(want, rel=1e-4)
    assert list(accuracy.metrics(*args, calibrated=False)) == ["credit/correlation"]


def test_metrics_without_step_rewards_are_nan():
    last = jnp.arange(6) % 3 == 2
    metrics = accuracy.metrics(jnp.arange(6.0), 5.0 * last, last, jnp.ones(6, bool), calibrated=True)
    assert np.isnan(list(metrics.values())).all()


def test_correlation_with_a_constant_is_nan():
    assert np.isnan(float(accuracy.masked_correlation(jnp.arange(5.0), jnp.ones(5), jnp.ones(5, bool))))
