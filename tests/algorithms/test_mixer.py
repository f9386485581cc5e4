"""QMIX's mixer against the worked example, and its monotonicity."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.numpy_qmix import PINNED, numpy_networks
from lare_rl.algorithms.qmix.mixer import Mixer, mix


def select(value, action):
    index = np.asarray(action)[..., None]
    return jnp.asarray(np.take_along_axis(np.asarray(value), index, axis=-1)[..., 0], jnp.float32)


def test_mix_worked_example():
    state = jnp.asarray(PINNED["state"], jnp.float32)
    online, target = (numpy_networks(PINNED[name]).mixer for name in ("online", "target"))
    q_total = mix(online, select(np.asarray(PINNED["q"])[:, :-1], PINNED["action"]), state[:, :-1])
    np.testing.assert_allclose(q_total, PINNED["q_total"], rtol=1e-5, atol=5e-6)
    v = mix(target, select(PINNED["q_target"], PINNED["best"]), state)
    np.testing.assert_allclose(v, PINNED["v"], rtol=1e-5, atol=5e-6)


def test_mix_without_mixer_is_sum():
    value = jnp.array([[1.0, -2.0, 4.0], [0.5, 0.0, 0.25]])
    np.testing.assert_allclose(mix(None, value, jnp.zeros((2, 0))), [3.0, 0.75])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31 - 1), st.floats(1e-2, 1e2), st.floats(1e-2, 1e2))
def test_mixer_is_monotonic(seed, parameter_scale, value_scale):
    mixer_key, value_key, state_key = jax.random.split(jax.random.key(seed), 3)
    mixer = jax.tree.map(lambda leaf: parameter_scale * leaf, Mixer(3, 5, 4, 6, key=mixer_key))
    value = value_scale * jax.random.normal(value_key, (20, 3))
    state = value_scale * jax.random.normal(state_key, (20, 5))
    assert (np.asarray(jax.grad(lambda value: mixer(value, state).sum())(value)) >= 0).all()


def test_mixer_weights_depend_on_state():
    mixer = Mixer(2, 3, 4, 5, key=jax.random.key(0))
    slope = jax.vmap(jax.grad(mixer), (None, 0))(jnp.zeros(2), jax.random.normal(jax.random.key(1), (2, 3)))
    assert not np.allclose(slope[0], slope[1], rtol=1e-3)
