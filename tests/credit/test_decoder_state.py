from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.methods import METHODS, Fit

EPISODES, STEPS, FEATURES = 64, 10, 3
KEY = jax.random.key(3)
init = jax.jit(decoder_state.init, static_argnames="spec")
update = jax.jit(descent.update, static_argnames="spec")
proxy_rewards = jax.jit(decoder_state.decoder_rewards, static_argnames="spec")


@partial(jax.jit, static_argnames="spec")
def fit_batches(state, batches, spec):
    """Make an update by each of some batches. Return the state and the losses."""

    def body(state, batch):
        state, metrics = descent.update(state, batch, KEY, spec)
        return state, metrics["credit/loss"]

    return jax.lax.scan(body, state, batches)


@jax.jit
def observe(state, rows, mean_reward, length):
    state = decoder_state.observe_steps(state, rows)
    return decoder_state.observe_returns(state, mean_reward, length, jnp.ones(len(length), bool), None)


def train(fit, settings, reward_scale=1.0, feature_scale=1.0, updates=400):
    """Train on rewards that are linear in the features. Return r_hat, the rewards and the losses."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(EPISODES, STEPS, FEATURES)).astype(np.float32)
    reward = (reward_scale * (features @ np.array([1.0, -2.0, 0.5], np.float32) + 1)).astype(np.float32)
    features *= feature_scale
    mean_reward, rows = reward.mean(axis=1), features.reshape(-1, FEATURES)
    spec = observation_spec(FEATURES, replace(METHODS["rd"], fit=fit), settings, STEPS)
    state = init(jax.random.key(0), spec)
    state = observe(state, rows, mean_reward, np.full(EPISODES, STEPS))
    k = STEPS if fit is Fit.ALL_STEPS else 5
    episodes = rng.permuted(np.tile(np.arange(EPISODES), (updates, 1)), axis=1)[:, :16]
    order = rng.permuted(np.tile(np.arange(STEPS), (updates, 16, 1)), axis=2)[..., :k]
    batches = CreditBatch(
        inputs=features[episodes[..., None], order].reshape(updates, -1, FEATURES),
        episode_index=np.tile(np.repeat(np.arange(16), k), (updates, 1)),
        length=np.full((updates, 16), STEPS),
        mean_reward=mean_reward[episodes],
        mask=np.ones((updates, 16), np.float32),
    )
    state, losses = fit_batches(state, batches, spec=spec)
    return np.asarray(proxy_rewards(state, rows, spec=spec)), reward.ravel(), losses


@pytest.mark.parametrize(
    ("fit", "changes"),
    [
        (Fit.ALL_STEPS, {"normalise": False}),
        (Fit.ALL_STEPS, {"sum_form": True}),
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


@pytest.mark.parametrize("score_type", [0, 1])
def test_unit_of_proxy_rewards(score_type):
    """A decoder's output is in units of R/T. If the score is a mean, it is in units of R, and a step gets a T-th of it."""
    settings = CreditSettings(hidden=(8,), score="average" if score_type else "sum")
    length = np.array([2, 4, 8])
    mean_reward, rows = np.array([3.0, -1.0, 0.5], np.float32), np.eye(FEATURES, dtype=np.float32)
    spec = observation_spec(FEATURES, METHODS["rd"], settings, STEPS)
    state = observe(init(KEY, spec), rows, mean_reward, length)
    output = decoder_state.decode(state.network, state, jnp.asarray(rows), spec).r_hat
    unit = np.sqrt(np.mean((mean_reward * (length if score_type else 1)) ** 2)) / (length if score_type else 1)
    np.testing.assert_allclose(proxy_rewards(state, rows, spec, length), unit * output, rtol=1e-5)


def test_valid_rows():
    """Episode 1 is padding, and so are rows of episode 2, which does not exist. An agent that has left has no row."""
    episode_index, zeros = np.array([0, 0, 1, 1, 2, 3]), np.zeros((6, 2, FEATURES), np.float32)
    alive = np.array([[True, False], *[[True, True]] * 5])
    batch = CreditBatch(zeros, episode_index, np.array([2, 2]), zeros[0, :, 0], mask=np.float32([1, 0]), alive=alive)
    np.testing.assert_array_equal(jax.jit(decoder_state.valid_rows)(batch), [alive[0], alive[1], *[[False, False]] * 4])
    batch = batch._replace(inputs=zeros[:, 0], alive=None)
    np.testing.assert_array_equal(jax.jit(decoder_state.valid_rows)(batch), [True, True, *[False] * 4])


def test_decoder_of_many_agents_soon_reaches_the_size_of_rare_rewards():
    """The reward of one in 200 steps of an agent is 10, and a factor says which. The mean reward is 0.05."""
    agents, steps, settings = 6, 25, CreditSettings(hidden=(64, 64, 64, 64), learning_rate=5e-4)
    rng = np.random.default_rng(0)
    rewarded = rng.uniform(size=(32, steps, agents)) < 0.005
    rows = np.stack([rewarded, rng.normal(size=rewarded.shape)], axis=-1).reshape(-1, agents, 2).astype(np.float32)
    mean_reward, length = (10 * rewarded.mean(axis=(1, 2))).astype(np.float32), np.full(32, steps)
    spec = observation_spec(2, METHODS["lare-rd"], settings, steps, agents)
    batch = CreditBatch(rows, np.repeat(np.arange(32), steps), length, mean_reward, mask=np.ones(32, np.float32))
    batches = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (100, *leaf.shape)), batch)
    state, _ = fit_batches(observe(init(KEY, spec), rows, mean_reward, length), batches, spec=spec)
    r_hat = np.asarray(proxy_rewards(state, rows, spec=spec))
    assert r_hat.ravel()[rewarded.ravel()].mean() == pytest.approx(10, abs=3)  # 1.5 without the gain of sqrt(nT)


def test_losses_of_packed_and_sampled_episodes_against_numpy():
    """The mean r_hat of each episode is compared with R/T. Padding is ignored. An empty batch has no gradient."""
    rng, settings = np.random.default_rng(0), CreditSettings(hidden=(8,), normalise=False, weight_decay=0.1)
    length, returns = np.array([3, 1, 5]), np.array([6.0, -2.0, 1.0], np.float32)
    rows = jnp.asarray(rng.normal(size=(12, FEATURES)), jnp.float32)
    spec = observation_spec(FEATURES, METHODS["rd"], settings, STEPS)
    state = init(KEY, spec)
    r_hat = np.asarray(proxy_rewards(state, rows, spec=spec))
    means = [values.mean() for values in np.split(r_hat[:9], [3, 4])]
    batch = CreditBatch(
        inputs=rows,
        episode_index=np.repeat(np.arange(4), [*length, 3]),
        length=length,
        mean_reward=returns / length,
        mask=np.ones(3),
    )
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


@pytest.mark.parametrize(("name", "sum_form"), [("rd", True), ("rrdu", False)])
def test_gradient_in_chunks_is_that_of_the_batch(name, sum_form):
    agents, n_episodes, n_chunks, fit = 3, 8, 4, METHODS[name].fit
    settings, k = CreditSettings(hidden=(8,), sum_form=sum_form), STEPS if fit is Fit.ALL_STEPS else 5
    rng = np.random.default_rng(0)
    features, target = rng.normal(size=(n_episodes * k, agents, FEATURES)), rng.normal(size=n_episodes)
    length = np.full(n_episodes, STEPS)
    spec = observation_spec(FEATURES, METHODS[name], settings, STEPS, agents)
    state = observe(init(KEY, spec), features, target, length)

    def batch(n_chunks):
        episode_index = np.tile(np.repeat(np.arange(n_episodes // n_chunks), k), n_chunks)
        return CreditBatch(features, episode_index, length, target, mask=np.ones(n_episodes))

    chunks = jax.tree.map(lambda leaf: leaf.reshape(n_chunks, -1, *leaf.shape[1:]), batch(n_chunks))
    update_in_chunks = jax.jit(descent.update_in_chunks, static_argnames="spec")
    results = [update(state, batch(1), KEY, spec), update_in_chunks(state, chunks, KEY, spec)]
    (unsplit, whole_loss), (chunked, chunked_loss) = (
        (new.optimizer, metrics["credit/loss"]) for new, metrics in results
    )
    for a, b in zip(jax.tree.leaves((unsplit, whole_loss)), jax.tree.leaves((chunked, chunked_loss)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_values_of_agents_that_have_left_make_no_difference():
    values, alive = jnp.array([[1.0, jnp.nan, 3.0]]), jnp.array([[True, False, True]])
    assert decoder_state.agent_mean(values, alive).tolist() == [2.0]
