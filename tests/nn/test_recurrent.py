"""The agent network of QMIX against a worked example, step by step and all steps at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_qmix import PINNED, numpy_networks, numpy_sequences
from lare_rl.algorithms.qmix import qmix
from lare_rl.nn.recurrent import RecurrentNetwork


@pytest.mark.parametrize(("name", "key"), [("online", "q"), ("target", "q_target")])
def test_action_values_of_the_worked_example(name, key):
    values = qmix.action_values(numpy_networks(PINNED[name]).agent, numpy_sequences())
    np.testing.assert_allclose(values, PINNED[key], rtol=1e-5, atol=2e-6)


def test_unroll_equals_single_steps():
    network = RecurrentNetwork(4, 5, 3, key=jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (6, 2, 7, 4))
    h, outputs = jnp.zeros((2, 7, 5)), []
    for x_t in x:
        output, h = network(x_t, h)
        outputs.append(output)
    np.testing.assert_allclose(network.unroll(x), jnp.stack(outputs), rtol=1e-5, atol=1e-6)


def test_unroll_is_causal_and_remembers():
    network = RecurrentNetwork(4, 5, 3, key=jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (6, 4))
    changed = np.asarray(network.unroll(x) != network.unroll(x.at[2].add(1.0))).any(axis=1)
    assert changed.tolist() == [False, False, True, True, True, True]


def test_initial_weights_are_those_of_pytorch():
    """They are uniform in ±1/sqrt(inputs), and all of the GRU in ±1/sqrt(width)."""
    network = RecurrentNetwork(25, 64, 9, key=jax.random.key(0))
    gru = network.gru
    for layer, size in (
        (network.encoder, 25),
        (gru.input_projection, 64),
        (gru.hidden_projection, 64),
        (network.head, 64),
    ):
        for leaf in jax.tree.leaves(layer):
            largest = float(jnp.abs(leaf).max()) * size**0.5
            assert (0.75 if leaf.size < 64 else 0.9) < largest <= 1
