import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_attention import numpy_mlp
from helpers.numpy_twins import equal, q_values, random_transitions
from lare_rl.algorithms.sac import SACSettings, sac
from lare_rl.nn.networks import MLP

SETTINGS = SACSettings(hidden=(8, 8), temperature=0.5, learning_rate=1e-3, target_every=2)
KEY, BATCH = jax.random.key(1), random_transitions()
init, update = jax.jit(sac.init, static_argnums=(1, 2, 3)), jax.jit(sac.update, static_argnums=4)
sample = jax.jit(sac.sample)


@pytest.fixture(scope="module")
def state():
    return init(jax.random.key(0), 3, 2, SETTINGS)


def numpy_sample(state, observation, key):
    """Return actions and log pi in double precision."""
    mean, log_std = np.split(numpy_mlp(state.online.actor, np.asarray(observation)).astype(np.float64), 2, axis=1)
    sigma = np.exp(log_std)
    u = mean + sigma * np.asarray(jax.random.normal(key, mean.shape))
    density = np.exp(-0.5 * ((u - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    return np.tanh(u), np.log(density / (1 - np.tanh(u) ** 2)).sum(axis=1)


def test_sample(state):
    action, log_pi = sample(state.online.actor, BATCH.observation, KEY)
    expected, expected_log_pi = numpy_sample(state, BATCH.observation, KEY)
    np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(log_pi, expected_log_pi, rtol=1e-4)
    noise = jax.random.normal(KEY, action.shape)
    np.testing.assert_allclose(sac.explore(state.online.actor, BATCH.observation, noise, SETTINGS), action, rtol=1e-5)
    mode = np.tanh(numpy_mlp(state.online.actor, np.asarray(BATCH.observation))[:, :2])
    np.testing.assert_allclose(sac.act(state.online.actor, BATCH.observation), mode, rtol=1e-5, atol=1e-6)


def test_sample_is_precise_where_tanh_is_flat():
    """For u = 20, tanh(u) is 1 in single precision, and its log slope is 2 (log 2 - u). The standard deviation is bounded."""
    network, noise = jax.tree.map(jnp.zeros_like, MLP(1, (), 2, key=KEY)), float(jax.random.normal(KEY, (1, 1))[0, 0])
    for log_std, clipped in ((-25.0, -20.0), (5.0, 2.0)):
        biased = eqx.tree_at(lambda network: network.layers[0].bias, network, jnp.array([20.0, log_std]))
        _, log_pi = sample(biased, jnp.zeros((1, 1)), KEY)
        u = 20 + np.exp(clipped) * noise
        expected = -0.5 * noise**2 - clipped - 0.5 * np.log(2 * np.pi) - 2 * (np.log(2) - u - np.log1p(np.exp(-2 * u)))
        assert float(log_pi[0]) == pytest.approx(expected, rel=1e-5)


def test_soft_td_targets(state):
    action, log_pi = numpy_sample(state, BATCH.next_observation, KEY)
    next_q = q_values(state.target, BATCH.next_observation, action)
    expected = BATCH.reward + 0.99 * (1 - BATCH.terminated) * (next_q.min(axis=0) - 0.5 * log_pi)
    got = jax.jit(sac.soft_td_targets, static_argnums=3)(state, BATCH, KEY, SETTINGS)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_update(state):
    """The targets move at every second update. The actor's loss is alpha log pi - min Q."""
    (first, metrics), (second, _) = (update(state, BATCH, KEY, jnp.array(index), SETTINGS) for index in (0, 1))
    assert equal(first.target, state.target)
    assert equal(first.online, second.online)
    expected = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, state.target, second.online.critics)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), second.target, expected)

    target_key, actor_key = jax.random.split(KEY)
    target_q = np.asarray(sac.soft_td_targets(state, BATCH, target_key, SETTINGS))
    error = q_values(state.online.critics, BATCH.observation, BATCH.action) - target_q
    assert float(metrics["critic/loss"]) == pytest.approx((error**2).mean(axis=1).sum(), rel=1e-4)
    assert float(metrics["critic/value"]) == pytest.approx(target_q.mean(), rel=1e-4)
    error_after = q_values(first.online.critics, BATCH.observation, BATCH.action) - target_q
    assert (error_after**2).mean() < (error**2).mean()

    def actor_loss(actor):
        action, log_pi = sac.sample(actor, BATCH.observation, actor_key)
        return jnp.mean(0.5 * log_pi - jnp.min(sac.q_values(first.online.critics, BATCH.observation, action), axis=0))

    # Adam's first mean is a tenth of the gradient.
    gradient, mean = jax.jit(jax.grad(actor_loss))(state.online.actor), first.actor_optimizer[0].mu
    jax.tree.map(lambda g, m: np.testing.assert_allclose(m, 0.1 * g, rtol=1e-3, atol=1e-6), gradient, mean)


@pytest.mark.parametrize(("log_std", "entropy", "falls"), [(-1.9, -1, True), (-5.0, -7.2, False)])
def test_update_temperature(state, log_std, entropy, falls):
    """Above the entropy -dim(A) = -2 the temperature falls, below it rises: by Adam's step size at the first step."""
    last = jax.tree.map(jnp.zeros_like, state.online.actor.layers[-1])
    last = eqx.tree_at(lambda layer: layer.bias, last, jnp.array([0.0, 0, log_std, log_std]))
    actor = eqx.tree_at(lambda actor: actor.layers[-1], state.online.actor, last)
    start = state._replace(online=state.online._replace(actor=actor))
    after, metrics = update(start, BATCH, KEY, jnp.array(0), SETTINGS)
    assert float(metrics["actor/entropy"]) == pytest.approx(entropy, abs=0.3)
    assert float(metrics["actor/temperature"]) == pytest.approx(0.5)
    change = float(after.online.log_temperature - state.online.log_temperature)
    assert change == pytest.approx(-1e-3 if falls else 1e-3, rel=1e-3)
