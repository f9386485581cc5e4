from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import fit_batches, observed_state, whole_batches
from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.methods import METHODS, Fit

EPISODES, SAMPLED, FEATURES, LENGTH = 3, 4, 2, 8
KEY = jax.random.key(0)
SETTINGS = CreditSettings(hidden=(16,), learning_rate=3e-3)
SPEC = observation_spec(FEATURES, METHODS["lrr"], CreditSettings(hidden=(8,), normalise=False), LENGTH)


@pytest.fixture(scope="module")
def state():
    return decoder_state.init(KEY, SPEC)


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    return CreditBatch(
        inputs=jnp.asarray(rng.normal(size=(EPISODES * SAMPLED, 1, FEATURES)), jnp.float32),
        episode_index=jnp.repeat(jnp.arange(EPISODES), SAMPLED),
        length=jnp.full(EPISODES, LENGTH),
        mean_reward=jnp.asarray(rng.normal(size=EPISODES), jnp.float32),
        mask=jnp.array([1.0, 1.0, 0.0]),
    )


def loss(state, batch, fit):
    spec = replace(SPEC, method=replace(SPEC.method, fit=fit))
    return jax.jit(lambda: descent.loss_and_gradient(state, batch, KEY, spec))()


def test_loss_against_numpy(state, batch):
    """The return, and the other steps' means, leave a reward for each sampled step. Each sampled step stands for T / K steps."""
    output = state.network(batch.inputs, None)
    mu, log_std = (np.asarray(values).reshape(EPISODES, SAMPLED) for values in (output.r_hat, output.log_std))
    want = []
    for episode in range(2):  # the third is padding
        total = float(batch.mean_reward[episode]) * LENGTH
        for t in range(SAMPLED):
            other_means = LENGTH / SAMPLED * mu[episode].sum() - mu[episode, t]
            std = LENGTH * np.exp(log_std[episode, t])
            density = np.exp(-(((total - other_means - mu[episode, t]) / std) ** 2) / 2) / (std * np.sqrt(2 * np.pi))
            want.append(-np.log(density))
    constant = np.log(LENGTH) + np.log(2 * np.pi) / 2
    assert float(loss(state, batch, Fit.LIKELIHOOD)[0]) == pytest.approx(np.mean(want) - constant, rel=1e-4)


def test_fixed_uncertainty_is_rrd(state, batch):
    last = state.network.mlp.layers[-1]
    fixed = eqx.tree_at(
        lambda layer: (layer.weight, layer.bias), last, (last.weight.at[:, 1].set(0), last.bias.at[1].set(0))
    )
    network = eqx.tree_at(lambda network: network.mlp.layers[-1], state.network, fixed)
    fixed_state = state._replace(network=network)
    (likelihood, gradient), (error, rrd_gradient) = (
        loss(fixed_state, batch, fit) for fit in (Fit.LIKELIHOOD, Fit.SAMPLED_STEPS)
    )
    assert float(likelihood) == pytest.approx(float(error) / 2, rel=1e-5)
    for a, b in zip(*(leaves.mlp.layers[:-1] for leaves in (gradient, rrd_gradient)), strict=True):
        np.testing.assert_allclose(a.weight, b.weight / 2, rtol=1e-4, atol=1e-6)


def test_must_learn_rewards_and_where_they_are_uncertain():
    """The mean reward is the first feature. Rewards are noisy where the second feature is positive."""
    spec, rng = observation_spec(FEATURES, METHODS["lrr"], SETTINGS, 3), np.random.default_rng(0)
    rows = rng.normal(size=(500, 128, 3, FEATURES)).astype(np.float32)
    noise = 2 * rng.normal(size=rows.shape[:-1]) * (rows[..., 1] > 0)
    batches = whole_batches(rows[..., None, :], (rows[..., 0] + noise).mean(axis=-1), 3)
    state = observed_state(spec, rows[0], batches.mean_reward[0], batches.length[0], KEY)
    state, _ = fit_batches(state, batches, spec)
    x = jnp.asarray(rows[0].reshape(-1, FEATURES))
    output = decoder_state.decode(state.network, state, x, spec)
    assert np.corrcoef(output.r_hat, x[:, 0])[0, 1] > 0.9
    log_std = np.asarray(output.log_std)
    assert log_std[x[:, 1] > 0.3].mean() > log_std[x[:, 1] < -0.3].mean() + 0.2
