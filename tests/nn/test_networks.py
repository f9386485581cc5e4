import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lare_rl.nn.networks import MLP, clipped, descend, move_towards, start_adam


def test_mlp_against_numpy():
    network = MLP(3, (5,), 2, key=jax.random.key(0))
    x = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    first, last = network.layers
    hidden = np.maximum(x @ np.asarray(first.weight) + np.asarray(first.bias), 0)
    want = hidden @ np.asarray(last.weight) + np.asarray(last.bias)
    np.testing.assert_allclose(network(jnp.asarray(x)), want, rtol=1e-5, atol=1e-6)


def test_one_row_and_a_batch_agree():
    network, x = MLP(3, (5, 5), 2, key=jax.random.key(0)), jnp.ones((4, 3))
    np.testing.assert_allclose(network(x)[0], network(x[0]), rtol=1e-6)


def test_descend_is_adam():
    parameters, gradient = jnp.array([1.0, -2.0]), jnp.array([0.1, 4.0])
    moved, _ = descend(parameters, gradient, start_adam(parameters, 0.01), 0.01)
    # Adam's first step is the learning rate in the direction of the sign.
    np.testing.assert_allclose(moved, [0.99, -2.01], rtol=1e-5)


@pytest.mark.parametrize(("most", "want"), [(6.5, [1.5, 2.0, 6.0]), (13.0, [3.0, 4.0, 12.0]), (20.0, [3.0, 4.0, 12.0])])
def test_a_gradient_is_clipped_as_a_whole(most, want):
    got = clipped({"a": jnp.array([3.0, 4.0]), "b": jnp.array(12.0)}, most)
    np.testing.assert_allclose([*got["a"], got["b"]], want, rtol=1e-6)


def test_no_gradient_stays_none():
    assert float(clipped(jnp.array(0.0), 1.0)) == 0


@pytest.mark.parametrize("tau", [0.0, 0.25, 1.0])
def test_move_towards(tau):
    old, new = {"a": jnp.array(1.0)}, {"a": jnp.array(3.0)}
    want = optax.incremental_update(new, old, tau)
    assert float(move_towards(old, new, tau)["a"]) == pytest.approx(float(want["a"]))
