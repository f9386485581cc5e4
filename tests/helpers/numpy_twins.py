"""What the NumPy twins of several algorithms need."""

import jax.numpy as jnp
import numpy as np

from lare_rl.algorithms.batches import Transitions


def random_transitions():
    """A batch of 16, of which every fourth terminates."""
    rng = np.random.default_rng(0)
    s, a, r, n = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in [(16, 3), (16, 2), (16,), (16, 3)])
    return Transitions(s, jnp.tanh(a), r, n, jnp.asarray(np.arange(16) % 4 == 0, jnp.float32))


def mlp_forward(network, x):
    """An MLP in plain NumPy."""
    for layer in network.layers[:-1]:
        x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return x @ np.asarray(network.layers[-1].weight) + np.asarray(network.layers[-1].bias)
