from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import make_decoder
from helpers.long_tests import long_case
from lare_rl.credit import decoder_state, descent
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.input_names import InputNames
from lare_rl.credit.methods import METHODS, Fit

EPISODES, STEPS, AGENTS, FEATURES = 4, 5, 3, 6
KEY = jax.random.key(1)
ROWS = np.random.default_rng(0).normal(size=(EPISODES * STEPS, AGENTS, FEATURES)).astype(np.float32)
DECODERS = ("step", "bottleneck", "lrr", "arel", "stas", "tar2")
SMALL = {"hidden": (8,), "encoder": (16,), "bottleneck": 2, "divergence": 0.1}


def small_decoder(name):
    sizes = {"observation": 4, "action": 2} if name == "tar2" else FEATURES
    return make_decoder(name, sizes, STEPS, AGENTS, seed=1, **SMALL)


@jax.jit
def decode(decoder, rows, key=None):
    return decoder(rows, key)


def episodes(values):
    return np.asarray(values).reshape(EPISODES, STEPS, AGENTS, *values.shape[2:])


@pytest.mark.parametrize("name", [long_case(name) if name == "tar2" else name for name in DECODERS])
def test_outputs(name):
    decoder = small_decoder(name)
    output = decode(decoder, ROWS)
    first, second = (decode(decoder, ROWS, jax.random.key(seed)) for seed in (1, 2))
    for result in (output, first):
        assert result.r_hat.shape == result.penalty.shape == (EPISODES * STEPS, AGENTS)
        assert np.isfinite(result.r_hat).all()
        assert (np.asarray(result.penalty) >= 0).all()
    assert (np.abs(first.r_hat - second.r_hat).max() > 1e-6) == (name in ("bottleneck", "stas", "tar2"))
    np.testing.assert_array_equal(decode(decoder, ROWS).r_hat, output.r_hat)
    # Credit is causal: neither later steps nor other episodes matter. Contributions of TAR2 depend on the outcome.
    changed = episodes(ROWS).copy()
    if name != "tar2":
        changed[:, 3:] = 7.0
    changed[1] = -7.0
    before, after = episodes(output.r_hat), episodes(decode(decoder, changed.reshape(ROWS.shape)).r_hat)
    np.testing.assert_allclose(before[[0, 2, 3], :3], after[[0, 2, 3], :3], rtol=1e-4, atol=1e-5)
    assert np.abs(before[1] - after[1]).max() > 1e-4
    if name == "arel":  # all agents get the same reward, in any order
        np.testing.assert_array_equal(before, np.broadcast_to(before[..., :1], before.shape))
        np.testing.assert_allclose(output.r_hat, decode(decoder, ROWS[:, ::-1]).r_hat, rtol=1e-4, atol=1e-5)
        want = 20 / STEPS**2 * before[..., 0].var(axis=1, ddof=1).mean()
        assert float(output.penalty.mean()) == pytest.approx(want, rel=1e-4)


def test_bottleneck_equations():
    decoder, noise = small_decoder("bottleneck"), jax.random.normal(KEY, (EPISODES * STEPS, AGENTS, 2))
    mean, log_variance = jnp.split(decoder.encoder(jnp.asarray(ROWS)), 2, axis=-1)
    assert float(jnp.abs(log_variance).max()) > 0.1
    for key, z in ((KEY, mean + jnp.sqrt(jnp.exp(log_variance)) * noise), (None, mean)):
        want = decoder.step_decoder(z, None).r_hat
        np.testing.assert_allclose(decode(decoder, ROWS, key).r_hat, want, rtol=1e-4, atol=1e-5)
    divergence = 0.5 * (np.exp(log_variance) + mean**2 - 1 - log_variance).sum(axis=-1)
    np.testing.assert_allclose(decode(decoder, ROWS, KEY).penalty, 0.1 * divergence, rtol=1e-5)


DISTINCT = {
    (method.fit, method.decoder): method.name
    for method in METHODS.values()
    if method.uses_gradient and not method.single_agent_only
}
QUICK = {DISTINCT[Fit.ALL_STEPS, "step"]}
"""The others take most of the time of this folder, to compile."""


@pytest.mark.parametrize("name", [name if name in QUICK else long_case(name) for name in DISTINCT.values()])
def test_must_learn_credit_among_agents_from_the_mean_return(name):
    """Each agent's reward is the first feature. Only the return of all agents is observed."""
    settings, method = CreditSettings(hidden=(16,), learning_rate=3e-3), METHODS[name]
    n_episodes, n_updates = 64, 20 if method.decoder_kind.whole_episodes else 300
    rows = np.random.default_rng(0).normal(size=(n_episodes, STEPS, AGENTS, 2)).astype(np.float32)
    reward, length = rows[..., 0], jnp.full(n_episodes, STEPS)
    mean_reward = reward.mean(axis=(1, 2))
    k = STEPS if method.fit is Fit.ALL_STEPS else 3

    two_inputs = replace(method, inputs=InputNames(("observation", "action")))
    spec = replace(observation_spec(1, method, settings, STEPS, AGENTS), method=two_inputs, action_size=1)

    def body(state, key):
        order = jax.vmap(lambda key: jax.random.permutation(key, STEPS)[:k])(jax.random.split(key, n_episodes))
        sample = jnp.asarray(rows)[jnp.arange(n_episodes)[:, None], jnp.sort(order, axis=1)].reshape(-1, AGENTS, 2)
        episode_index = jnp.repeat(jnp.arange(n_episodes), k)
        batch = CreditBatch(sample, episode_index, length, jnp.asarray(mean_reward), mask=jnp.ones(n_episodes))
        state, metrics = descent.update(state, batch, key, spec)
        return state, metrics["credit/loss"]

    @jax.jit
    def train():
        state = decoder_state.init(KEY, spec)
        state = decoder_state.observe_steps(state, jnp.asarray(rows))
        state = decoder_state.observe_returns(state, jnp.asarray(mean_reward), length, jnp.ones(n_episodes, bool), None)
        state, losses = jax.lax.scan(body, state, jax.random.split(jax.random.key(0), n_updates))
        return decoder_state.decoder_rewards(state, jnp.asarray(rows).reshape(-1, AGENTS, 2), spec), losses

    r_hat, losses = train()
    assert float(losses[-5:].mean()) < float(losses[:5].mean())
    if method.decoder in ("step", "lrr"):
        assert np.corrcoef(np.ravel(r_hat), reward.ravel())[0, 1] > 0.9
