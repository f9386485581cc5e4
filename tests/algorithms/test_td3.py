"""TD3's update against a slow NumPy twin, and its rules one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.twins import forward, transitions
from lare_rl.algorithms import td3
from lare_rl.algorithms.settings import TD3Settings
from lare_rl.algorithms.table import DDPG

SETTINGS = TD3Settings(hidden=(8, 8), batch_size=16)
init, update = jax.jit(td3.init, static_argnums=(1, 2, 3)), jax.jit(td3.update, static_argnums=4)


@pytest.fixture(scope="module")
def state():
    return init(jax.random.key(0), 3, 2, SETTINGS)


@pytest.fixture(scope="module")
def batch():
    return transitions()


def one_of(critics, place):
    return jax.tree.map(lambda leaf: leaf[place], critics)


def test_target_against_numpy(state, batch):
    quiet = TD3Settings(hidden=(8, 8), policy_noise=0)
    y = td3.target_values(state.target, batch, jax.random.key(1), quiet)
    action = np.tanh(forward(state.target.actor, np.asarray(batch.next_observation)))
    x = np.concatenate([batch.next_observation, action], axis=1)
    future = np.minimum(*(forward(one_of(state.target.critics, i), x)[:, 0] for i in range(2)))
    np.testing.assert_allclose(y, batch.reward + 0.99 * batch.continues * future, rtol=1e-5, atol=1e-6)


def test_a_termination_ends_the_bootstrap_and_nothing_else_does(state, batch):
    y = td3.target_values(state.target, batch, jax.random.key(1), SETTINGS)
    ended = np.asarray(batch.continues) == 0
    np.testing.assert_array_equal(y[ended], batch.reward[ended])
    assert (np.asarray(y) != np.asarray(batch.reward))[~ended].all()


def test_smoothing_noise_is_clipped(state, batch):
    """With all noise at its bound the target is that of the action moved by the bound."""
    loud = TD3Settings(hidden=(8, 8), policy_noise=1e6, noise_clip=0.25)
    y = td3.target_values(state.target, batch, jax.random.key(1), loud)
    signs = np.sign(np.asarray(jax.random.normal(jax.random.key(1), batch.action.shape)))
    action = np.tanh(forward(state.target.actor, np.asarray(batch.next_observation)))
    x = np.concatenate([batch.next_observation, np.clip(action + 0.25 * signs, -1, 1)], axis=1)
    future = np.minimum(*(forward(one_of(state.target.critics, i), x)[:, 0] for i in range(2)))
    np.testing.assert_allclose(y, batch.reward + 0.99 * batch.continues * future, rtol=1e-4, atol=1e-5)


def test_policy_and_targets_wait_for_their_turn(state, batch):
    update = jax.jit(lambda turn: td3.update(state, batch, jax.random.key(2), turn, SETTINGS)[0])
    waited, acted = update(jnp.array(0)), update(jnp.array(1))
    same = lambda a, b: jax.tree.all(jax.tree.map(jnp.array_equal, a, b))  # noqa: E731
    assert same(waited.online.actor, state.online.actor)
    assert same(waited.target, state.target)
    assert same(waited.online.critics, acted.online.critics)
    assert not same(waited.online.critics, state.online.critics)
    assert not same(acted.online.actor, state.online.actor)
    moved = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, state.target, acted.online)
    for a, b in zip(jax.tree.leaves(acted.target), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)


def test_critic_loss_is_the_sum_of_both_squared_errors(state, batch):
    _, metrics = update(state, batch, jax.random.key(2), jnp.array(0), SETTINGS)
    y = np.asarray(td3.target_values(state.target, batch, jax.random.key(2), SETTINGS))
    x = np.concatenate([batch.observation, batch.action], axis=1)
    want = sum(((forward(one_of(state.online.critics, i), x)[:, 0] - y) ** 2).mean() for i in range(2))
    assert float(metrics["critic/loss"]) == pytest.approx(want, rel=1e-4)


def test_the_critics_start_apart(state):
    first, second = (one_of(state.online.critics, i) for i in range(2))
    assert not np.array_equal(first.layers[0].weight, second.layers[0].weight)


def test_networks_start_as_published(state):
    # Uniform in ±1/sqrt(fan-in), as the published code's linear layers do.
    weight = np.asarray(state.online.actor.layers[1].weight)
    assert np.abs(weight).max() <= 8**-0.5
    assert np.abs(weight).max() > 0.9 * 8**-0.5


def test_ddpg_is_one_critic_without_noise_or_delay(batch):
    settings = DDPG.model_copy(update={"hidden": (8, 8)})
    start = init(jax.random.key(0), 3, 2, settings)
    assert {leaf.shape[0] for leaf in jax.tree.leaves(start.online.critics)} == {1}
    y = td3.target_values(start.target, batch, jax.random.key(1), settings)
    action = np.tanh(forward(start.target.actor, np.asarray(batch.next_observation)))
    x = np.concatenate([batch.next_observation, action], axis=1)
    future = forward(one_of(start.target.critics, 0), x)[:, 0]
    np.testing.assert_allclose(y, batch.reward + 0.99 * batch.continues * future, rtol=1e-5, atol=1e-6)
    after, _ = update(start, batch, jax.random.key(2), jnp.array(0), settings)
    assert not jax.tree.all(jax.tree.map(jnp.array_equal, after.target, start.target))
