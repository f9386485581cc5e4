"""SAC's update against a NumPy twin."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_twins import mlp_forward, random_transitions
from lare_rl.algorithms.sac import SACSettings, sac
from lare_rl.nn.networks import MLP

SETTINGS = SACSettings(hidden=(8, 8), temperature=0.5)
KEY = jax.random.key(1)
init, update = jax.jit(sac.init, static_argnums=(1, 2, 3)), jax.jit(sac.update, static_argnums=4)


@pytest.fixture(scope="module")
def state():
    return init(jax.random.key(0), 3, 2, SETTINGS)


@pytest.fixture(scope="module")
def batch():
    return random_transitions()


def numpy_sample(state, observation, key):
    """Actions and log pi in double precision."""
    mu, log_sigma = np.split(mlp_forward(state.online.actor, np.asarray(observation)).astype(np.float64), 2, axis=1)
    sigma = np.exp(log_sigma)
    u = mu + sigma * np.asarray(jax.random.normal(key, mu.shape))
    density = np.exp(-0.5 * ((u - mu) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    return np.tanh(u), np.log(density / (1 - np.tanh(u) ** 2)).sum(axis=1)


def test_sample(state, batch):
    action, log_pi = sac.sample(state.online.actor, batch.observation, KEY)
    expected, expected_log_pi = numpy_sample(state, batch.observation, KEY)
    np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(log_pi, expected_log_pi, rtol=1e-4)
    noise = jax.random.normal(KEY, action.shape)
    np.testing.assert_allclose(sac.explore(state.online.actor, batch.observation, noise, SETTINGS), action, rtol=1e-5)


def test_sample_is_precise_where_tanh_is_flat():
    """For u = 20, tanh(u) is 1 in single precision, and its log slope is 2 (log 2 - u)."""
    network = jax.tree.map(jnp.zeros_like, MLP(1, (), 2, key=KEY))
    network = eqx.tree_at(lambda network: network.layers[0].bias, network, jnp.array([20.0, -20.0]))
    _, log_pi = sac.sample(network, jnp.zeros((1, 1)), KEY)
    noise = float(jax.random.normal(KEY, (1, 1))[0, 0])
    expected = -0.5 * noise**2 + 20 - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - 20)
    assert float(log_pi[0]) == pytest.approx(expected, rel=1e-5)


def test_soft_td_targets(state, batch):
    action, log_pi = numpy_sample(state, batch.next_observation, KEY)
    x = np.concatenate([batch.next_observation, action], axis=1)
    next_q = np.stack([mlp_forward(jax.tree.map(lambda leaf, i=i: leaf[i], state.target), x)[:, 0] for i in range(2)])
    expected = batch.reward + 0.99 * (1 - batch.terminated) * (next_q.min(axis=0) - 0.5 * log_pi)
    np.testing.assert_allclose(sac.soft_td_targets(state, batch, KEY, SETTINGS), expected, rtol=1e-4, atol=1e-5)


def test_update_delays_targets(state, batch):
    def equal(a, b):
        return jax.tree.all(jax.tree.map(jnp.array_equal, a, b))

    first, second = (update(state, batch, KEY, jnp.array(index), SETTINGS)[0] for index in (0, 1))
    assert equal(first.target, state.target)
    assert equal(first.online, second.online)
    expected = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, state.target, second.online.critics)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), second.target, expected)


@pytest.mark.parametrize(("log_sigma", "entropy", "falls"), [(0.0, 1.2, True), (-1.9, -1, True), (-5.0, -7.2, False)])
def test_update_temperature(state, batch, log_sigma, entropy, falls):
    """Above the entropy -dim(A) = -2 the temperature falls, below it rises: by Adam's step size at the first step."""
    last = jax.tree.map(jnp.zeros_like, state.online.actor.layers[-1])
    last = eqx.tree_at(lambda layer: layer.bias, last, jnp.array([0.0, 0, log_sigma, log_sigma]))
    actor = eqx.tree_at(lambda actor: actor.layers[-1], state.online.actor, last)
    start = state._replace(online=state.online._replace(actor=actor))
    after, metrics = update(start, batch, KEY, jnp.array(0), SETTINGS)
    assert float(metrics["actor/entropy"]) == pytest.approx(entropy, abs=0.3)
    assert float(metrics["actor/temperature"]) == pytest.approx(0.5)
    change = float(after.online.log_temperature - state.online.log_temperature)
    assert change == pytest.approx(-3e-4 if falls else 3e-4, rel=1e-3)


def test_update_lowers_actor_loss(state, batch):
    """The loss is alpha log pi - min Q, at the same noise."""
    fast = SACSettings(hidden=(8, 8), learning_rate=1e-3)
    after, _ = update(state, batch, KEY, jnp.array(0), fast)

    def loss(actor):
        action, log_pi = sac.sample(actor, batch.observation, jax.random.split(KEY)[1])
        q = jnp.min(sac.q_values(after.online.critics, batch.observation, action), axis=0)
        return float(jnp.mean(0.5 * log_pi - q))

    assert loss(after.online.actor) < loss(state.online.actor)
