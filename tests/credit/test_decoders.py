"""What all decoders have in common: shapes, causality, where they are random, and that they learn."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.long_tests import long_case
from lare_rl.credit import decomposition, descent
from lare_rl.credit.arel import AREL
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decomposition import CreditBatch
from lare_rl.credit.methods import METHODS, Fit
from lare_rl.credit.stas import STAS
from lare_rl.credit.step_decoders import Bottleneck, StepDecoder

EPISODES, STEPS, AGENTS, FEATURES = 4, 5, 3, 6
KEY = jax.random.key(1)
DECODERS = {
    "step": partial(StepDecoder, FEATURES, (8,), 2.0),
    "bottleneck": partial(Bottleneck, FEATURES, (16,), 2, (8,), 0.1, 2.0),
    "arel": partial(AREL, FEATURES, STEPS),
    "stas": partial(STAS, FEATURES, STEPS, AGENTS, 2.0),
}


@pytest.fixture(params=DECODERS)
def name(request):
    return request.param


@pytest.fixture
def decoder(name):
    return DECODERS[name](key=KEY)


@pytest.fixture(scope="module")
def rows():
    values = np.random.default_rng(0).normal(size=(EPISODES * STEPS, AGENTS, FEATURES))
    return jnp.asarray(values, jnp.float32)


@jax.jit
def decode(decoder, rows, key=None):
    return decoder(rows, key)


def test_output_has_a_row_for_each_step_and_agent(decoder, rows):
    for key in (None, KEY):
        output = decode(decoder, rows, key)
        assert output.r_hat.shape == output.penalty.shape == (EPISODES * STEPS, AGENTS)
        assert np.isfinite(output.r_hat).all()
        assert (np.asarray(output.penalty) >= 0).all()


def test_randomness_needs_a_key(name, decoder, rows):
    first, second = (decode(decoder, rows, jax.random.key(seed)).r_hat for seed in (1, 2))
    assert (np.abs(first - second).max() > 1e-6) == (name in ("bottleneck", "stas"))
    np.testing.assert_array_equal(decode(decoder, rows).r_hat, decode(decoder, rows).r_hat)


def test_credit_is_causal(decoder, rows):
    """Neither later steps nor other episodes matter."""
    episodes = rows.reshape(EPISODES, STEPS, AGENTS, FEATURES)
    changed = episodes.at[:, 3:].set(7.0).at[1].set(-7.0)
    before, after = (
        np.asarray(decode(decoder, values.reshape(rows.shape)).r_hat).reshape(EPISODES, STEPS, AGENTS)
        for values in (episodes, changed)
    )
    np.testing.assert_allclose(before[[0, 2, 3], :3], after[[0, 2, 3], :3], rtol=1e-4, atol=1e-5)
    assert np.abs(before[1] - after[1]).max() > 1e-4


def test_bottleneck_equations(rows):
    decoder, noise = DECODERS["bottleneck"](key=KEY), jax.random.normal(KEY, (EPISODES * STEPS, AGENTS, 2))
    mean, log_variance = jnp.split(decoder.encoder(rows), 2, axis=-1)
    assert float(jnp.abs(log_variance).max()) > 0.1
    for key, z in ((KEY, mean + jnp.sqrt(jnp.exp(log_variance)) * noise), (None, mean)):
        want = decoder.decoder(z, None).r_hat
        np.testing.assert_allclose(decoder(rows, key).r_hat, want, rtol=1e-4, atol=1e-5)
    divergence = 0.5 * (np.exp(log_variance) + mean**2 - 1 - log_variance).sum(axis=-1)
    np.testing.assert_allclose(decoder(rows, KEY).penalty, 0.1 * divergence, rtol=1e-5)


DISTINCT = {
    (method.fit, method.decoder): method
    for method in METHODS.values()
    if method.uses_gradient and not method.single_agent_only
}


@pytest.mark.parametrize(
    "method",
    [long_case(row) if "vib" in row.name else row for row in DISTINCT.values()],
    ids=lambda method: method.name,
)
def test_must_learn_credit_among_agents_from_the_mean_return(method):
    """Each agent's reward is the first feature. Only the return of all agents is observed."""
    settings = CreditSettings(hidden=(16,), learning_rate=3e-3)
    n_episodes, n_updates = 64, 20 if method.needs_whole_episodes else 300
    rows = np.random.default_rng(0).normal(size=(n_episodes, STEPS, AGENTS, 2)).astype(np.float32)
    reward, length = rows[..., 0], jnp.full(n_episodes, STEPS)
    mean_reward = jnp.asarray(reward.mean(axis=(1, 2)))
    state = decomposition.init(KEY, 2, method, settings, STEPS, AGENTS)
    state = decomposition.observe_steps(state, jnp.asarray(rows))
    state = decomposition.observe_returns(state, mean_reward, length, jnp.ones(n_episodes, bool))
    k = STEPS if method.fit is Fit.ALL_STEPS else 3

    def body(state, key):
        order = jax.vmap(lambda key: jax.random.permutation(key, STEPS)[:k])(jax.random.split(key, n_episodes))
        sample = jnp.asarray(rows)[jnp.arange(n_episodes)[:, None], jnp.sort(order, axis=1)].reshape(-1, AGENTS, 2)
        episode_index = jnp.repeat(jnp.arange(n_episodes), k)
        batch = CreditBatch(sample, episode_index, length, mean_reward, mask=jnp.ones(n_episodes))
        state, metrics = descent.update(state, batch, key, method.fit, settings)
        return state, metrics["credit/loss"]

    keys = jax.random.split(jax.random.key(0), n_updates)
    state, losses = jax.jit(lambda state: jax.lax.scan(body, state, keys))(state)
    assert float(losses[-5:].mean()) < float(losses[:5].mean())
    if method.decoder == "step":
        r_hat = decomposition.proxy_rewards(state, jnp.asarray(rows).reshape(-1, AGENTS, 2), settings)
        assert np.corrcoef(np.ravel(r_hat), reward.ravel())[0, 1] > 0.9
