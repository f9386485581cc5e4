"""SAC's update against a slow NumPy twin, and its rules one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.twins import forward, transitions
from lare_rl.algorithms import sac
from lare_rl.algorithms.settings import SACSettings
from lare_rl.nn.networks import MLP

SETTINGS = SACSettings(hidden=(8, 8), temperature=0.5)
init, update = jax.jit(sac.init, static_argnums=(1, 2, 3)), jax.jit(sac.update, static_argnums=4)


@pytest.fixture(scope="module")
def state():
    return init(jax.random.key(0), 3, 2, SETTINGS)


@pytest.fixture(scope="module")
def batch():
    return transitions()


def drawn(state, observation, key):
    """Actions and log pi in plain NumPy, double precision."""
    mean, log_sigma = np.split(forward(state.online.actor, np.asarray(observation)).astype(np.float64), 2, axis=1)
    sigma = np.exp(log_sigma)
    u = mean + sigma * np.asarray(jax.random.normal(key, mean.shape))
    density = np.exp(-0.5 * ((u - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    return np.tanh(u), np.log(density / (1 - np.tanh(u) ** 2)).sum(axis=1)


def test_actions_and_their_density_against_numpy(state, batch):
    key = jax.random.key(4)
    action, log_pi = sac.sample(state.online.actor, batch.observation, key)
    want, want_log = drawn(state, batch.observation, key)
    np.testing.assert_allclose(action, want, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(log_pi, want_log, rtol=1e-4)


def test_the_density_holds_its_digits_where_the_tanh_is_flat():
    """For u = 20, tanh(u) is 1 in single precision, and the log slope of it is 2 (log 2 - u)."""
    network = MLP(1, (), 2, key=jax.random.key(0))
    far = jax.tree.map(jnp.zeros_like, network)
    far = jax.tree.map(lambda leaf: jnp.array([20.0, -20.0]) if leaf.shape == (2,) else leaf, far)
    _, log_pi = sac.sample(far, jnp.zeros((1, 1)), jax.random.key(0))
    noise = jax.random.normal(jax.random.key(0), (1, 1))[0, 0]
    want = -0.5 * noise**2 + 20 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 20)
    assert float(log_pi[0]) == pytest.approx(float(want), rel=1e-5)


def test_target_against_numpy(state, batch):
    key = jax.random.key(1)
    y = sac.target_values(state, batch, key, SETTINGS)
    action, log_pi = drawn(state, batch.next_observation, key)
    x = np.concatenate([batch.next_observation, action], axis=1)
    first, second = (forward(jax.tree.map(lambda leaf: leaf[i], state.target), x)[:, 0] for i in range(2))  # noqa: B023
    want = batch.reward + 0.99 * batch.continues * (np.minimum(first, second) - 0.5 * log_pi)
    np.testing.assert_allclose(y, want, rtol=1e-4, atol=1e-5)


def test_targets_wait_for_their_turn(state, batch):
    update = jax.jit(lambda number: sac.update(state, batch, jax.random.key(2), number, SETTINGS)[0])
    waited, moved = update(jnp.array(0)), update(jnp.array(1))
    same = lambda a, b: jax.tree.all(jax.tree.map(jnp.array_equal, a, b))  # noqa: E731
    assert same(waited.target, state.target)
    assert same(waited.online, moved.online)
    assert not same(waited.online.actor, state.online.actor)
    want = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, state.target, moved.online.critics)
    for a, b in zip(jax.tree.leaves(moved.target), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("log_sigma", "entropy", "falls"), [(0.0, 1.2, True), (-1.9, -1, True), (-5.0, -7.2, False)])
def test_the_temperature_follows_the_entropy(state, batch, log_sigma, entropy, falls):
    """Where the entropy is above -dim(A) = -2 it falls, else it rises: by Adam's step size, at the first step."""
    layers = state.online.actor.layers
    last = jax.tree.map(jnp.zeros_like, layers[-1])
    last = jax.tree.map(lambda leaf: jnp.array([0.0, 0, log_sigma, log_sigma]) if leaf.shape == (4,) else leaf, last)
    actor = eqx.tree_at(lambda actor: actor.layers[-1], state.online.actor, last)
    start = state._replace(online=state.online._replace(actor=actor))
    after, measured = update(start, batch, jax.random.key(2), jnp.array(0), SETTINGS)
    assert float(measured["actor/entropy"]) == pytest.approx(entropy, abs=0.3)
    assert float(measured["actor/temperature"]) == pytest.approx(0.5)
    change = float(after.online.log_temperature - state.online.log_temperature)
    assert change == pytest.approx(-3e-4 if falls else 3e-4, rel=1e-3)


def test_the_policy_descends_its_loss(state, batch):
    """alpha log pi - min Q, at the same noise, is smaller after a step than before."""
    key = jax.random.split(jax.random.key(2))[1]
    fast = SACSettings(hidden=(8, 8), learning_rate=1e-3)
    after, _ = update(state, batch, jax.random.key(2), jnp.array(0), fast)

    def loss(actor):
        action, log_pi = sac.sample(actor, batch.observation, key)
        value = jnp.min(sac.values(after.online.critics, batch.observation, action), axis=0)
        return float(jnp.mean(0.5 * log_pi - value))

    assert loss(after.online.actor) < loss(state.online.actor)
