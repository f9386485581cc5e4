"""What the NumPy twins of several algorithms need."""

import jax
import jax.numpy as jnp
import numpy as np

from helpers.numpy_attention import numpy_mlp
from lare_rl.algorithms.batches import Transitions


def random_transitions():
    """Return a batch of 16 steps. Every fourth terminates."""
    rng = np.random.default_rng(0)
    s, a, r, n = (np.asarray(rng.normal(size=shape), np.float32) for shape in [(16, 3), (16, 2), (16,), (16, 3)])
    return Transitions(*map(jnp.asarray, (s, np.tanh(a), r, n, np.float32(np.arange(16) % 4 == 0))))


def q_values(critics, observation, action):
    """Return the values of each critic."""
    x, critics = np.concatenate([observation, action], axis=1), jax.tree.map(np.asarray, critics)
    count = len(critics.layers[0].weight)
    return np.stack([numpy_mlp(jax.tree.map(lambda leaf, i=i: leaf[i], critics), x)[:, 0] for i in range(count)])


def equal(a, b):
    return jax.tree.all(jax.tree.map(np.array_equal, a, b))


def assert_close(a, b, rtol=1e-4, atol=1e-5):
    """Assert that two trees of arrays are equal but for rounding."""
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol), a, b)
