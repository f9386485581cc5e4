"""Numbers of a slow NumPy twin of QMIX for two episodes, and its gradient by differences in float64.

It has networks of two units, two agents with three actions, and episodes of two and of three steps (`qmix_pinned.json`).
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.algorithms.batches import Sequences
from lare_rl.algorithms.qmix import QMIXSettings, qmix
from lare_rl.algorithms.qmix.qmix import Networks

PINNED = json.loads((Path(__file__).parent / "qmix_pinned.json").read_text())
SETTINGS = QMIXSettings(hidden=2, embed=2, hypernet=2)

LEAVES = "fc1.w fc1.b gru.wi gru.bi gru.wh gru.bh fc2.w fc2.b".split() + [
    f"{layer}.{kind}" for layer in "w1a w1b b1 w2a w2b b2a b2b".split() for kind in "wb"
]
"""The twin's arrays in the order of our networks."""


def swap_gates(leaf):
    """Convert between the order of gates r, z, n (the twin, PyTorch) and z, r, n (ours)."""
    r, z, n = np.split(leaf, 3, axis=-1)
    return np.concatenate([z, r, n], axis=-1)


def numpy_networks(numbers) -> Networks:
    """Convert the twin's parameters, or its gradient, to our networks."""
    arrays, start = {}, 0
    for name, shape in PINNED["order"]:
        leaf = np.reshape(numbers[start : start + np.prod(shape)], shape)
        arrays[name] = jnp.asarray(swap_gates(leaf) if name.startswith("gru") else leaf, jnp.float32)
        start += np.prod(shape)
    state = jax.eval_shape(lambda: qmix.init(jax.random.key(0), 2, 2, 3, 2, SETTINGS))
    return jax.tree.unflatten(jax.tree.structure(state.online), [arrays[name] for name in LEAVES])


def numpy_sequences() -> Sequences:
    def array(name, dtype=jnp.float32):
        return jnp.asarray(PINNED[name], dtype)

    action = jax.nn.one_hot(array("action", int), 3)
    return Sequences(
        array("obs"), array("state"), array("legal", bool), action, *map(array, ("reward", "terminated", "mask"))
    )
