from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import decoder_rewards, fit_batches, observed_state, whole_batches
from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.methods import METHODS, Fit

EPISODES, STEPS, FEATURES = 64, 10, 3
KEY = jax.random.key(3)
update = jax.jit(descent.update, static_argnames="spec")


def train(fit, settings, reward_scale=1.0, feature_scale=1.0, updates=400):
    """Train on rewards that are linear in the features. Return r_hat, the rewards and the losses."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(EPISODES, STEPS, FEATURES)).astype(np.float32)
    reward = (reward_scale * (features @ np.array([1.0, -2.0, 0.5], np.float32) + 1)).astype(np.float32)
    features *= feature_scale
    mean_reward, rows = reward.mean(axis=1), features.reshape(-1, FEATURES)
    spec = observation_spec(FEATURES, replace(METHODS["rd"], fit=fit), settings, STEPS)
    state = observed_state(spec, rows, mean_reward, np.full(EPISODES, STEPS), jax.random.key(0))
    k = STEPS if fit is Fit.ALL_STEPS else 5
    episodes = rng.permuted(np.tile(np.arange(EPISODES), (updates, 1)), axis=1)[:, :16]
    order = rng.permuted(np.tile(np.arange(STEPS), (updates, 16, 1)), axis=2)[..., :k]
    batches = whole_batches(features[episodes[..., None], order], mean_reward[episodes], STEPS)
    state, losses = fit_batches(state, batches, spec)
    return np.asarray(decoder_rewards(state, rows, spec)), reward.ravel(), losses


@pytest.mark.parametrize(
    ("fit", "changes"),
    [
        (Fit.ALL_STEPS, {"normalise": False, "sum_form": True}),
        (Fit.SAMPLED_STEPS, {}),
        (Fit.SAMPLED_STEPS_UNBIASED, {}),
    ],
)
def test_must_learn_step_rewards(fit, changes):
    r_hat, reward, _ = train(fit, CreditSettings(hidden=(32,), learning_rate=1e-2, **changes))
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.9
    if fit is not Fit.SAMPLED_STEPS:  # its bias shrinks r_hat towards the mean
        assert np.abs(r_hat - reward).mean() < 0.5 * np.abs(reward - reward.mean()).mean()


def test_scales_of_rewards_and_features_do_not_matter():
    settings, fit = CreditSettings(hidden=(16,), learning_rate=1e-3), Fit.SAMPLED_STEPS_UNBIASED
    r_hat, _, losses = train(fit, settings, updates=100)
    for name, scale in [("reward_scale", 1e-3), ("reward_scale", 1e3), ("feature_scale", 1e-3), ("feature_scale", 1e3)]:
        scaled_r_hat, _, scaled_losses = train(fit, settings, updates=100, **{name: scale})
        np.testing.assert_allclose(losses, scaled_losses, rtol=1e-2, atol=1e-3)
        unit = scale if name == "reward_scale" else 1.0
        np.testing.assert_allclose(r_hat, scaled_r_hat / unit, rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("is_average", [False, True])
def test_sum_form_weighs_sums_by_their_lengths_and_averages_equally(is_average):
    """In units of the returns' scale, the error of both episodes is 1 for an average, and 1/T for a mean reward."""
    settings = CreditSettings(hidden=(), sum_form=True, score="average" if is_average else "sum", normalise=False)
    spec = observation_spec(1, METHODS["rd"], settings, 4)
    state = decoder_state.init(KEY, spec)._replace(is_average=jnp.array(is_average))
    state = state._replace(network=jax.tree.map(jnp.zeros_like, state.network))  # r_hat = 0
    losses = []
    for length in (2, 4):
        ones = jnp.ones(1)
        batch = CreditBatch(jnp.zeros((length, 1, 1)), jnp.zeros(length, int), jnp.array([length]), ones / length, ones)
        losses.append(float(update(state, batch, KEY, spec)[1]["credit/loss"]))
    np.testing.assert_allclose(losses, 1, rtol=1e-5)


@pytest.mark.parametrize("score_type", [0, 1])
def test_unit_of_proxy_rewards(score_type):
    """A decoder's output is in units of R/T. If the score is a mean, it is in units of R, and a step gets a T-th of it."""
    settings = CreditSettings(hidden=(8,), score="average" if score_type else "sum")
    length = np.array([2, 4, 8])
    mean_reward, rows = np.array([3.0, -1.0, 0.5], np.float32), np.eye(FEATURES, dtype=np.float32)
    spec = observation_spec(FEATURES, METHODS["rd"], settings, STEPS)
    state = observed_state(spec, rows, mean_reward, length, KEY)
    output = decoder_state.decode(state.network, state, jnp.asarray(rows), spec).r_hat
    unit = np.sqrt(np.mean((mean_reward * (length if score_type else 1)) ** 2)) / (length if score_type else 1)
    np.testing.assert_allclose(decoder_rewards(state, rows, spec, length), unit * output, rtol=1e-5)


def test_valid_rows_and_agents():
    """Episode 1 is padding, and so are rows of episode 2, which does not exist. An agent that has left has no row, and no value."""
    episode_index, zeros = np.array([0, 0, 1, 1, 2, 3]), np.zeros((6, 2, FEATURES), np.float32)
    alive = np.array([[True, False], *[[True, True]] * 5])
    batch = CreditBatch(zeros, episode_index, np.array([2, 2]), zeros[0, :, 0], mask=np.float32([1, 0]), alive=alive)
    np.testing.assert_array_equal(jax.jit(decoder_state.valid_rows)(batch), [alive[0], alive[1], *[[False, False]] * 4])
    batch = batch._replace(inputs=zeros[:, 0], alive=None)
    np.testing.assert_array_equal(jax.jit(decoder_state.valid_rows)(batch), [True, True, *[False] * 4])
    values, alive = jnp.array([[1.0, jnp.nan, 3.0]]), jnp.array([[True, False, True]])
    assert decoder_state.agent_mean(values, alive).tolist() == [2.0]


@pytest.mark.long
def test_decoder_of_many_agents_soon_reaches_the_size_of_rare_rewards():
    """The reward of one in 200 steps of an agent is 10, and a factor says which. The mean reward is 0.05."""
    agents, steps, settings = 6, 25, CreditSettings(hidden=(64, 64, 64, 64), learning_rate=5e-4)
    rng = np.random.default_rng(0)
    rewarded = rng.uniform(size=(32, steps, agents)) < 0.005
    rows = np.stack([rewarded, rng.normal(size=rewarded.shape)], axis=-1).astype(np.float32)
    mean_reward = 10 * rewarded.mean(axis=(1, 2))
    spec = observation_spec(2, METHODS["lare-rd"], settings, steps, agents)
    batches = whole_batches(np.broadcast_to(rows, (100, *rows.shape)), mean_reward, steps)
    state = observed_state(spec, rows, batches.mean_reward[0], batches.length[0], KEY)
    r_hat = np.asarray(decoder_rewards(fit_batches(state, batches, spec)[0], rows.reshape(-1, agents, 2), spec))
    assert r_hat.ravel()[rewarded.ravel()].mean() == pytest.approx(10, abs=3)  # 1.5 without the gain of sqrt(nT)


def test_losses_of_packed_and_sampled_episodes_against_numpy():
    """The mean r_hat of each episode is compared with R/T. Padding is ignored. An empty batch has no gradient."""
    rng, settings = np.random.default_rng(0), CreditSettings(hidden=(8,), normalise=False, weight_decay=0.1)
    length, returns = np.array([3, 1, 5]), np.array([6.0, -2.0, 1.0], np.float32)
    rows = jnp.asarray(rng.normal(size=(12, FEATURES)), jnp.float32)
    spec = observation_spec(FEATURES, METHODS["rd"], settings, STEPS)
    state = jax.jit(decoder_state.init, static_argnames="spec")(KEY, spec)
    r_hat = np.asarray(decoder_rewards(state, rows, spec))
    means = [values.mean() for values in np.split(r_hat[:9], [3, 4])]
    index = np.repeat(np.arange(4), [*length, 3])
    batch = CreditBatch(rows, index, length, mean_reward=returns / length, mask=np.ones(3))
    _, metrics = update(state, batch, KEY, spec=spec)
    want = np.mean((means - returns / length) ** 2)
    assert float(metrics["credit/loss"]) == pytest.approx(want, rel=1e-4)
    sampled = batch._replace(episode_index=np.array([0, 0, 0, 3, 1, 3, 3, 3, 2, 2, 2, 2]))  # at most 4 of each
    means = [r_hat[:3].mean(), r_hat[4], r_hat[8:].mean()]
    sampling = replace(spec, method=replace(spec.method, fit=Fit.SAMPLED_STEPS))
    _, metrics = update(state, sampled, KEY, spec=sampling)
    assert float(metrics["credit/loss"]) == pytest.approx(np.mean((means - returns / length) ** 2), rel=1e-4)
    after, metrics = update(state, batch._replace(mask=np.zeros(3)), KEY, spec=spec)
    assert float(metrics["credit/loss"]) == 0.0
    for weight, new in zip(jax.tree.leaves(state.network), jax.tree.leaves(after.network), strict=True):
        decayed = weight - settings.learning_rate * np.sign(weight)  # Adam's first step for the decay alone
        np.testing.assert_allclose(new, decayed, atol=3e-5)
