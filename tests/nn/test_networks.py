import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.nn.networks import MLP, bound_log_std


def test_mlp_against_numpy():
    network = MLP(3, (5,), 2, key=jax.random.key(0))
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    first, last = network.layers
    hidden = np.maximum(x @ np.asarray(first.weight) + np.asarray(first.bias), 0)
    want = hidden @ np.asarray(last.weight) + np.asarray(last.bias)
    np.testing.assert_allclose(network(jnp.asarray(x)), want, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(network(jnp.asarray(x[0])), want[0], rtol=1e-5, atol=1e-6)


def test_bound_log_std():
    x = jnp.array([-100.0, 0.1, 100.0])
    np.testing.assert_allclose(bound_log_std(x), [-5, 0.1, 5], rtol=1e-3)
    assert float(jax.grad(bound_log_std)(8.0)) > 0.05
