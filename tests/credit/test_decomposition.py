"""Step rewards are learned from returns alone, at any scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import decomposition, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import CreditBatch
from lare_rl.credit.methods import METHODS, Fit

EPISODES, STEPS, FEATURES = 64, 10, 3
KEY = jax.random.key(3)


def train(fit, settings, reward_scale=1.0, feature_scale=1.0, updates=600):
    """Train on rewards that are linear in the features. Return r_hat, the rewards and the losses."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(EPISODES, STEPS, FEATURES)).astype(np.float32)
    reward = (reward_scale * (features @ np.array([1.0, -2.0, 0.5], np.float32) + 1)).astype(np.float32)
    features *= feature_scale
    mean_reward, rows = reward.mean(axis=1), jnp.asarray(features.reshape(-1, FEATURES))
    state = decomposition.init(jax.random.key(0), FEATURES, METHODS["rd"], settings, STEPS, 1)
    state = decomposition.observe_steps(state, rows)
    valid = jnp.ones(EPISODES, bool)
    state = decomposition.observe_returns(state, jnp.asarray(mean_reward), jnp.full(EPISODES, STEPS), valid)
    k = STEPS if fit is Fit.ALL_STEPS else 5
    rng = np.random.default_rng(1)
    update = jax.jit(lambda state, batch: descent.update(state, batch, KEY, fit, settings))
    losses = []
    for _ in range(updates):
        episodes = rng.choice(EPISODES, 16, replace=False)
        order = np.stack([rng.permutation(STEPS)[:k] for _ in episodes])
        batch = CreditBatch(
            features=jnp.asarray(features[episodes[:, None], order].reshape(-1, FEATURES)),
            episode_index=jnp.repeat(jnp.arange(16), k),
            length=jnp.full(16, STEPS),
            mean_reward=jnp.asarray(mean_reward[episodes]),
            mask=jnp.ones(16),
        )
        state, metrics = update(state, batch)
        losses.append(float(metrics["credit/loss"]))
    return np.asarray(decomposition.proxy_rewards(state, rows, settings)), reward.ravel(), losses


@pytest.mark.parametrize("normalise", [True, False], ids=["normalised", "published"])
@pytest.mark.parametrize("fit", [Fit.ALL_STEPS, Fit.SAMPLED_STEPS, Fit.SAMPLED_STEPS_UNBIASED])
def test_must_learn_step_rewards(fit, normalise):
    settings = CreditSettings(hidden=(32, 32), normalise=normalise, learning_rate=3e-3)
    r_hat, reward, _ = train(fit, settings)
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.9
    if fit is not Fit.SAMPLED_STEPS:  # its bias shrinks r_hat towards the mean
        assert np.abs(r_hat - reward).mean() < 0.5 * np.abs(reward - reward.mean()).mean()


def test_must_learn_step_rewards_in_sum_form():
    r_hat, reward, _ = train(Fit.ALL_STEPS, CreditSettings(hidden=(32, 32), learning_rate=3e-3, sum_form=True))
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.9


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("scaled", ["reward_scale", "feature_scale"])
def test_scales_of_rewards_and_features_do_not_matter(scaled, factor):
    settings = CreditSettings(hidden=(16,), learning_rate=1e-3)
    r_hat, _, losses = train(Fit.SAMPLED_STEPS_UNBIASED, settings, updates=100)
    scaled_r_hat, _, scaled_losses = train(Fit.SAMPLED_STEPS_UNBIASED, settings, updates=100, **{scaled: factor})
    np.testing.assert_allclose(losses, scaled_losses, rtol=1e-2, atol=1e-3)
    unit = factor if scaled == "reward_scale" else 1.0
    np.testing.assert_allclose(r_hat, scaled_r_hat / unit, rtol=2e-2, atol=2e-2)


def test_decoder_of_many_agents_soon_reaches_the_size_of_rare_rewards():
    """The reward of one in 200 steps of an agent is 10, and a factor says which. The mean reward is 0.05."""
    agents, steps, settings = 6, 25, CreditSettings(hidden=(64, 64, 64, 64), learning_rate=5e-4)
    rng = np.random.default_rng(0)
    rewarded = rng.uniform(size=(EPISODES, steps, agents)) < 0.005
    factors = np.stack([rewarded, rng.normal(size=rewarded.shape)], axis=-1)
    rows = jnp.asarray(factors.reshape(-1, agents, 2), jnp.float32)
    mean_reward = jnp.asarray(10 * rewarded.mean(axis=(1, 2)), jnp.float32)
    length, mask = jnp.full(EPISODES, steps), jnp.ones(EPISODES)
    state = decomposition.init(KEY, 2, METHODS["lare-rd"], settings, steps, agents)
    state = decomposition.observe_returns(decomposition.observe_steps(state, rows), mean_reward, length, mask > 0)
    batch = CreditBatch(rows, jnp.repeat(jnp.arange(EPISODES), steps), length, mean_reward, mask=mask)
    update = jax.jit(lambda state: descent.update(state, batch, KEY, Fit.ALL_STEPS, settings)[0])
    for _ in range(100):
        state = update(state)
    r_hat = np.asarray(decomposition.proxy_rewards(state, rows, settings)).ravel()
    assert r_hat[rewarded.ravel()].mean() == pytest.approx(10, abs=3)  # 1.5 without the gain of sqrt(nT)


def test_empty_batch_changes_nothing():
    settings = CreditSettings(hidden=(8,), sum_form=True)
    state = decomposition.init(KEY, FEATURES, METHODS["rd"], settings, STEPS, 1)
    batch = CreditBatch(jnp.ones((4, FEATURES)), jnp.zeros(4, int), jnp.ones(1, int), jnp.zeros(1), mask=jnp.zeros(1))
    after, metrics = descent.update(state, batch, KEY, Fit.ALL_STEPS, settings)
    assert float(metrics["credit/loss"]) == 0.0
    assert jax.tree.all(jax.tree.map(jnp.array_equal, state.decoder, after.decoder))


def test_loss_of_packed_episodes_against_numpy():
    """The mean r_hat of each episode is compared with R/T. Padding after the last step is ignored."""
    rng, settings = np.random.default_rng(0), CreditSettings(hidden=(8,), normalise=False)
    length, returns = np.array([3, 1, 5]), np.array([6.0, -2.0, 1.0], np.float32)
    rows = jnp.asarray(rng.normal(size=(12, FEATURES)), jnp.float32)
    state = decomposition.init(KEY, FEATURES, METHODS["rd"], settings, STEPS, 1)
    r_hat = np.asarray(decomposition.proxy_rewards(state, rows, settings))
    means = [values.mean() for values in np.split(r_hat[:9], [3, 4])]
    batch = CreditBatch(
        features=rows,
        episode_index=jnp.repeat(jnp.arange(4), jnp.array([*length, 3])),
        length=jnp.asarray(length),
        mean_reward=jnp.asarray(returns / length),
        mask=jnp.ones(3),
    )
    _, metrics = descent.update(state, batch, KEY, Fit.ALL_STEPS, settings)
    want = np.mean((means - returns / length) ** 2)
    assert float(metrics["credit/loss"]) == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize("sum_form", [False, True], ids=["mean", "sum"])
@pytest.mark.parametrize("name", ["rd", "rrd", "rrdu"])
def test_gradient_in_chunks_is_that_of_the_batch(name, sum_form):
    agents, n_episodes, fit = 3, 8, METHODS[name].fit
    settings, k = CreditSettings(hidden=(8,), sum_form=sum_form), STEPS if fit is Fit.ALL_STEPS else 5
    features = jax.random.normal(KEY, (n_episodes * k, agents, FEATURES))
    target, length = jax.random.normal(KEY, (n_episodes,)), jnp.full(n_episodes, STEPS)
    state = decomposition.init(KEY, FEATURES, METHODS[name], settings, STEPS, agents)
    state = decomposition.observe_returns(state, target, length, jnp.ones(n_episodes, bool))

    def chunks(n_chunks):
        episode_index = jnp.tile(jnp.repeat(jnp.arange(n_episodes // n_chunks), k), n_chunks)
        batch = CreditBatch(features, episode_index, length, target, mask=jnp.ones(n_episodes))
        return jax.tree.map(lambda leaf: leaf.reshape(n_chunks, -1, *leaf.shape[1:]), batch)

    batch = jax.tree.map(lambda leaf: leaf[0], chunks(1))
    want, _ = descent.update(state, batch, KEY, fit, settings)
    update = jax.jit(lambda chunks: descent.update_in_chunks(state, chunks, KEY, fit, settings)[0])
    for n_chunks in (1, 4):
        optimizer = update(chunks(n_chunks)).optimizer
        for a, b in zip(jax.tree.leaves(optimizer), jax.tree.leaves(want.optimizer), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
