import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_attention import numpy_mlp
from helpers.numpy_twins import equal, q_values, random_transitions
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.algorithms.td3 import TD3Settings, td3

SETTINGS = TD3Settings(hidden=(8, 8), batch_size=16)
DDPG = ALGORITHMS["ddpg"].settings.model_copy(update={"hidden": (8, 8)})
KEY, BATCH = jax.random.key(1), random_transitions()
init, update = jax.jit(td3.init, static_argnums=(1, 2, 3)), jax.jit(td3.update, static_argnums=4)


@pytest.fixture(scope="module")
def state():
    return init(jax.random.key(0), 3, 2, SETTINGS)


@pytest.mark.parametrize(
    ("settings", "noise"),
    [
        (TD3Settings(hidden=(8, 8), policy_noise=0), 0),
        (TD3Settings(hidden=(8, 8), policy_noise=1e6, noise_clip=0.25), 0.25),  # all noise is at its bound
    ],
)
def test_td_targets(settings, noise, state):
    signs = np.sign(jax.random.normal(KEY, BATCH.action.shape))
    action = np.tanh(numpy_mlp(state.target.actor, np.asarray(BATCH.next_observation)))
    next_q = q_values(state.target.critics, BATCH.next_observation, np.clip(action + noise * signs, -1, 1))
    assert len(next_q) == settings.critics
    expected = BATCH.reward + 0.99 * (1 - BATCH.terminated) * next_q.min(axis=0)
    np.testing.assert_allclose(td3.td_targets(state.target, BATCH, KEY, settings), expected, rtol=1e-4, atol=1e-5)


def test_update_delays_policy_and_targets(state):
    (first, metrics), (second, _) = (update(state, BATCH, KEY, jnp.array(index), SETTINGS) for index in (0, 1))
    target_q = np.asarray(td3.td_targets(state.target, BATCH, KEY, SETTINGS))
    error = q_values(state.online.critics, BATCH.observation, BATCH.action) - target_q
    assert float(metrics["critic/loss"]) == pytest.approx((error**2).mean(axis=1).sum(), rel=1e-4)
    assert float(metrics["critic/value"]) == pytest.approx(target_q.mean(), rel=1e-4)
    assert equal(first.online.actor, state.online.actor)
    assert equal(first.target, state.target)
    assert equal(first.online.critics, second.online.critics)
    error_after = q_values(first.online.critics, BATCH.observation, BATCH.action) - target_q
    assert (error_after**2).mean() < (error**2).mean()
    expected = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, state.target, second.online)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), second.target, expected)
    q_before, q_after = (
        q_values(second.online.critics, BATCH.observation, td3.act(actor, BATCH.observation))[0].mean()
        for actor in (state.online.actor, second.online.actor)
    )
    assert q_after > q_before  # by critic 1
    ddpg = init(jax.random.key(0), 3, 2, DDPG)  # it has one critic, and no delay
    assert len(ddpg.online.critics.layers[0].weight) == 1
    assert not equal(update(ddpg, BATCH, KEY, jnp.array(0), DDPG)[0].target, ddpg.target)


def test_explore_and_init(state):
    """Actions are clipped. Weights are uniform in ±1/sqrt(fan-in), as published, and each critic differs."""
    noise = jnp.full((16, 2), 1e3).at[0].set(1.0)
    action = td3.explore(state.online.actor, BATCH.observation, noise, SETTINGS)
    np.testing.assert_allclose(action[0], td3.act(state.online.actor, BATCH.observation)[0] + 0.1, rtol=1e-5)
    np.testing.assert_array_equal(action[1:], 1)
    assert 0.9 * 8**-0.5 < np.abs(state.online.actor.layers[1].weight).max() <= 8**-0.5
    first, second = state.online.critics.layers[0].weight
    assert not np.array_equal(first, second)
