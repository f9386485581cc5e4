"""The mixer against the worked example, and what makes it QMIX's: no agent's value ever counts against the team."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.worked_qmix import PINNED, networks
from lare_rl.algorithms.mixer import Mixer, mixed


def chosen(value, action):
    return jnp.asarray(
        np.take_along_axis(np.asarray(value), np.asarray(action)[..., None], axis=-1)[..., 0], jnp.float32
    )


def test_totals_are_those_of_the_worked_example():
    state = jnp.asarray(PINNED["state"], jnp.float32)
    taken = chosen(np.asarray(PINNED["q"])[:, :-1], PINNED["action"])
    total = mixed(networks(PINNED["online"]).mixer, taken, state[:, :-1])
    np.testing.assert_allclose(total, PINNED["q_total"], rtol=1e-5, atol=5e-6)
    best = chosen(PINNED["q_target"], PINNED["best"])
    np.testing.assert_allclose(mixed(networks(PINNED["target"]).mixer, best, state), PINNED["v"], rtol=1e-5, atol=5e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31 - 1), st.floats(1e-2, 1e2), st.floats(1e-2, 1e2))
def test_the_total_never_falls_where_a_value_rises(seed, of_parameters, of_values):
    mixer_key, value_key, state_key = jax.random.split(jax.random.key(seed), 3)
    mixer = jax.tree.map(lambda leaf: of_parameters * leaf, Mixer(3, 5, 4, 6, key=mixer_key))
    value = of_values * jax.random.normal(value_key, (20, 3))
    state = of_values * jax.random.normal(state_key, (20, 5))
    slope = np.asarray(jax.grad(lambda value: mixer(value, state).sum())(value))
    assert (slope >= 0).all()


def test_without_a_mixer_it_is_the_sum():
    value = jnp.array([[1.0, -2.0, 4.0], [0.5, 0.0, 0.25]])
    np.testing.assert_allclose(mixed(None, value, jnp.zeros((2, 0))), [3.0, 0.75])


def test_the_state_decides_what_an_agent_counts():
    mixer = Mixer(2, 3, 4, 5, key=jax.random.key(0))
    slope = jax.vmap(jax.grad(mixer), (None, 0))(jnp.zeros(2), jax.random.normal(jax.random.key(1), (2, 3)))
    assert not np.allclose(slope[0], slope[1], rtol=1e-3)
