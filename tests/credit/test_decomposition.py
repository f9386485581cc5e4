"""The learner finds step rewards from returns alone, whatever their scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import decomposition, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import Episodes
from lare_rl.credit.methods import METHODS, Fit
from lare_rl.errors import LareError

EPISODES, LENGTH, FEATURES = 64, 10, 3
KEY = jax.random.key(3)


def data(scale=1.0, feature_scale=1.0, seed=0):
    """Episodes whose step reward is a linear function of the features."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(EPISODES, LENGTH, FEATURES)).astype(np.float32)
    reward = scale * (features @ np.array([1.0, -2.0, 0.5], np.float32) + 1)
    return features * feature_scale, reward.astype(np.float32)


def train(fit, settings, scale=1.0, feature_scale=1.0, updates=600):
    features, reward = data(scale, feature_scale)
    state = decomposition.init(jax.random.key(0), FEATURES, METHODS["rd"], settings, LENGTH, 1)
    state = decomposition.observe_steps(state, jnp.asarray(features.reshape(-1, FEATURES)))
    state = decomposition.observe_returns(
        state, jnp.asarray(reward.mean(axis=1)), jnp.full(EPISODES, LENGTH), jnp.ones(EPISODES, bool)
    )
    steps = LENGTH if fit is Fit.ALL_STEPS else 5
    rng = np.random.default_rng(1)
    update = jax.jit(lambda state, episodes: descent.update(state, episodes, KEY, fit, settings))
    losses = []
    for _ in range(updates):
        chosen = rng.choice(EPISODES, 16, replace=False)
        order = np.stack([rng.permutation(LENGTH)[:steps] for _ in chosen])
        rows = features[chosen[:, None], order].reshape(-1, FEATURES)
        episode = np.repeat(np.arange(16), steps)
        length, mean = jnp.full(16, LENGTH), jnp.asarray(reward[chosen].mean(axis=1))
        state, metrics = update(state, Episodes(jnp.asarray(rows), jnp.asarray(episode), length, mean, jnp.ones(16)))
        losses.append(float(metrics["credit/loss"]))
    r_hat = decomposition.proxy_rewards(state, jnp.asarray(features.reshape(-1, FEATURES)), settings)
    return np.asarray(r_hat), reward.ravel(), losses


@pytest.mark.parametrize("normalise", [True, False], ids=["normalised", "published"])
@pytest.mark.parametrize("fit", [Fit.ALL_STEPS, Fit.DRAWN_STEPS, Fit.DRAWN_STEPS_UNBIASED])
def test_must_learn_step_rewards_from_returns(fit, normalise):
    settings = CreditSettings(hidden=(32, 32), normalise=normalise, learning_rate=3e-3)
    r_hat, reward, _ = train(fit, settings)
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.9
    if fit is not Fit.DRAWN_STEPS:  # whose bias shrinks r_hat towards its mean
        assert np.abs(r_hat - reward).mean() < 0.5 * np.abs(reward - reward.mean()).mean()


def test_sum_form_learns_too():
    r_hat, reward, _ = train(Fit.ALL_STEPS, CreditSettings(hidden=(32, 32), learning_rate=3e-3, sum_form=True))
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.9


def test_many_agents_decoder_soon_reaches_the_size_of_rare_rewards():
    """One step of one agent in 200 pays 10, and a factor says which; the mean reward of an episode is 0.05."""
    agents, steps, episodes, settings = 6, 25, 64, CreditSettings(hidden=(64, 64, 64, 64), learning_rate=5e-4)
    rng = np.random.default_rng(0)
    paid = rng.uniform(size=(episodes, steps, agents)) < 0.005
    noise = rng.normal(size=paid.shape)
    rows = jnp.asarray(np.stack([paid, noise], axis=-1).reshape(-1, agents, 2), jnp.float32)
    mean_reward = jnp.asarray(10 * paid.mean(axis=(1, 2)), jnp.float32)
    state = decomposition.init(KEY, 2, METHODS["lare-rd"], settings, steps, agents)
    episode, length, ones = jnp.repeat(jnp.arange(episodes), steps), jnp.full(episodes, steps), jnp.ones(episodes)
    state = decomposition.observe_returns(decomposition.observe_steps(state, rows), mean_reward, length, ones > 0)
    batch = Episodes(rows, episode, length, mean_reward, ones)
    update = jax.jit(lambda state: descent.update(state, batch, KEY, Fit.ALL_STEPS, settings)[0])
    for _ in range(100):
        state = update(state)
    r_hat = np.asarray(decomposition.proxy_rewards(state, rows, settings)).ravel()
    assert r_hat[paid.ravel()].mean() == pytest.approx(10, abs=3)  # 1.5 without the factor of sqrt(nT)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("what", ["scale", "feature_scale"])
def test_scaled_returns_and_features_train_the_same(what, factor):
    settings = CreditSettings(hidden=(16,), learning_rate=1e-3)
    plain, _, losses = train(Fit.DRAWN_STEPS_UNBIASED, settings, updates=100)
    scaled, _, scaled_losses = train(Fit.DRAWN_STEPS_UNBIASED, settings, updates=100, **{what: factor})
    np.testing.assert_allclose(losses, scaled_losses, rtol=1e-2, atol=1e-3)
    unit = factor if what == "scale" else 1.0
    np.testing.assert_allclose(plain, scaled / unit, rtol=2e-2, atol=2e-2)


def test_without_an_episode_nothing_is_learned():
    settings = CreditSettings(hidden=(8,), sum_form=True)
    state = decomposition.init(jax.random.key(0), FEATURES, METHODS["rd"], settings, LENGTH, 1)
    episodes = Episodes(jnp.ones((4, FEATURES)), jnp.zeros(4, int), jnp.ones(1, int), jnp.zeros(1), jnp.zeros(1))
    after, metrics = descent.update(state, episodes, KEY, Fit.ALL_STEPS, settings)
    assert float(metrics["credit/loss"]) == 0.0
    assert jax.tree.all(jax.tree.map(jnp.array_equal, state.decoder, after.decoder))


@pytest.mark.parametrize("sum_form", [False, True], ids=["mean", "sum"])
@pytest.mark.parametrize("method", ["rd", "rrd", "rrdu"])
def test_a_gradient_in_parts_is_that_of_the_whole(method, sum_form):
    agents, count, row = 3, 8, METHODS[method]
    settings = CreditSettings(hidden=(8,), sum_form=sum_form)
    rows = LENGTH if row.fit is Fit.ALL_STEPS else 5
    features = jax.random.normal(KEY, (count * rows, agents, FEATURES))
    target = jax.random.normal(KEY, (count,))
    state = decomposition.init(KEY, FEATURES, row, settings, LENGTH, agents)
    state = decomposition.observe_returns(state, target, jnp.full(count, LENGTH), jnp.ones(count, bool))

    def episodes(parts):
        episode = jnp.tile(jnp.repeat(jnp.arange(count // parts), rows), parts)
        whole = Episodes(features, episode, jnp.full(count, LENGTH), target, jnp.ones(count))
        return jax.tree.map(lambda leaf: leaf.reshape(parts, -1, *leaf.shape[1:]), whole)

    one, _ = jax.jit(lambda: descent.update_in_parts(state, episodes(1), KEY, row.fit, settings))()
    four, _ = jax.jit(lambda: descent.update_in_parts(state, episodes(4), KEY, row.fit, settings))()
    assert jax.tree.map(jnp.shape, one) == jax.tree.map(jnp.shape, four)
    for whole, parts in zip(jax.tree.leaves(one.optimizer), jax.tree.leaves(four.optimizer), strict=True):
        np.testing.assert_allclose(whole, parts, rtol=1e-4, atol=1e-6)
    alone, _ = descent.update(state, jax.tree.map(lambda leaf: leaf[0], episodes(1)), KEY, row.fit, settings)
    for whole, parts in zip(jax.tree.leaves(one.optimizer), jax.tree.leaves(alone.optimizer), strict=True):
        np.testing.assert_allclose(whole, parts, rtol=1e-4, atol=1e-6)


def test_whole_episodes_and_padding():
    """Mean r_hat of each episode against R/T, whatever stands behind the last step."""
    rng = np.random.default_rng(0)
    features = [rng.normal(size=(length, FEATURES)).astype(np.float32) for length in (3, 1, 5)]
    returns, settings = [6.0, -2.0, 1.0], CreditSettings(hidden=(8,), normalise=False)
    state = decomposition.init(jax.random.key(0), FEATURES, METHODS["rd"], settings, LENGTH, 1)
    r_hat = [np.asarray(decomposition.proxy_rewards(state, jnp.asarray(one), settings)) for one in features]
    want = np.mean([(of_one.mean() - paid / len(of_one)) ** 2 for of_one, paid in zip(r_hat, returns, strict=True)])
    for rows in (9, 30):
        episodes = decomposition.whole_episodes(features, returns, rows)
        assert episodes.features.shape == (rows, FEATURES)
        _, metrics = descent.update(state, episodes, KEY, Fit.ALL_STEPS, settings)
        assert float(metrics["credit/loss"]) == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize(("lengths", "message"), [((3, 5), "8 steps of 2 episodes"), ((3, 0), "3 steps of 2 episodes")])
def test_episodes_that_have_no_room(lengths, message):
    features = [np.zeros((length, FEATURES), np.float32) for length in lengths]
    with pytest.raises(LareError, match=f"{message}: each needs at least one step, and all together at most 7"):
        decomposition.whole_episodes(features, [1.0, 1.0], 7)
