"""The agent network against the worked example, one step at a time and all at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.worked_qmix import PINNED, networks, sequences
from lare_rl.algorithms import qmix
from lare_rl.nn.recurrent import Recurrent


@pytest.mark.parametrize(("who", "key"), [("online", "q"), ("target", "q_target")])
def test_values_are_those_of_the_worked_example(who, key):
    value = qmix.action_values(networks(PINNED[who]).agent, sequences())
    np.testing.assert_allclose(value, PINNED[key], rtol=1e-5, atol=2e-6)


def test_steps_one_by_one_are_all_steps_at_once():
    network = Recurrent(4, 5, 3, key=jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (6, 2, 7, 4))
    h, steps = jnp.zeros((2, 7, 5)), []
    for now in x:
        out, h = network(now, h)
        steps.append(out)
    np.testing.assert_allclose(network.unroll(x), jnp.stack(steps), rtol=1e-5, atol=1e-6)


def test_what_was_seen_is_remembered_and_what_comes_is_not_known():
    network = Recurrent(4, 5, 3, key=jax.random.key(0))
    x = jax.random.normal(jax.random.key(1), (6, 4))
    changed = np.asarray(network.unroll(x) != network.unroll(x.at[2].add(1.0))).any(axis=1)
    assert changed.tolist() == [False, False, True, True, True, True]


def test_it_starts_as_pytorch_does():
    """Uniform in ±1/sqrt(inputs), all of the GRU in ±1/sqrt(width)."""
    network = Recurrent(25, 64, 9, key=jax.random.key(0))
    for layer, size in (
        (network.encoder, 25),
        (network.memory.given, 64),
        (network.memory.kept, 64),
        (network.decoder, 64),
    ):
        for leaf in jax.tree.leaves(layer):
            most = float(jnp.abs(leaf).max()) * size**0.5
            assert (0.75 if leaf.size < 64 else 0.9) < most <= 1
