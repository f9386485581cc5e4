import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.nn.networks import MLP, adam_step, clip_gradient, init_adam, polyak_update, smooth_clip


def test_mlp_against_numpy():
    network = MLP(3, (5,), 2, key=jax.random.key(0))
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    first, last = network.layers
    hidden = np.maximum(x @ np.asarray(first.weight) + np.asarray(first.bias), 0)
    want = hidden @ np.asarray(last.weight) + np.asarray(last.bias)
    np.testing.assert_allclose(network(jnp.asarray(x)), want, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(network(jnp.asarray(x[0])), want[0], rtol=1e-5, atol=1e-6)


def test_adam_step():
    parameters, gradient = jnp.array([1.0, -2.0]), jnp.array([0.1, 4.0])
    parameters, _ = adam_step(parameters, gradient, init_adam(parameters, 0.01), 0.01)
    # Adam's first step is the learning rate in the direction of the sign.
    np.testing.assert_allclose(parameters, [0.99, -2.01], rtol=1e-5)


def test_clip_gradient():
    for max_norm, expected in [(6.5, [1.5, 2, 6]), (13.0, [3, 4, 12]), (20.0, [3, 4, 12])]:
        clipped = clip_gradient({"a": jnp.array([3.0, 4.0]), "b": jnp.array(12.0)}, max_norm)
        np.testing.assert_allclose([*clipped["a"], clipped["b"]], expected, rtol=1e-6)
    assert float(clip_gradient(jnp.array(0.0), 1.0)) == 0


def test_polyak_update():
    for tau, expected in [(0.0, 1.0), (0.25, 1.5), (1.0, 3.0)]:
        assert polyak_update({"a": jnp.array(1.0)}, {"a": jnp.array(3.0)}, tau) == {"a": expected}


def test_smooth_clip():
    x = jnp.array([-100.0, 0.1, 100.0])
    np.testing.assert_allclose(smooth_clip(x, 5.0), [-5, 0.1, 5], rtol=1e-3)
    assert float(jax.grad(lambda x: smooth_clip(x, 5.0))(8.0)) > 0.05
