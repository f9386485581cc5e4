from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import decoder_rewards, fit_batches, make_decoder, observed_state, whole_batches
from helpers.long_tests import long_case
from lare_rl.credit.decoder_settings import CreditSettings
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
        assert result.r_hat.shape == (EPISODES * STEPS, AGENTS)
        assert np.isfinite(result.r_hat).all()
        if result.penalty is not None:
            assert result.penalty.shape == result.r_hat.shape
            assert (result.penalty >= 0).all()
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
    settings, method, rng = CreditSettings(hidden=(16,), learning_rate=3e-3), METHODS[name], np.random.default_rng(0)
    n_episodes, n_updates = 64, 20 if method.decoder_kind.whole_episodes else 300
    rows = rng.normal(size=(n_episodes, STEPS, AGENTS, 2)).astype(np.float32)
    reward, flat = rows[..., 0], rows.reshape(-1, AGENTS, 2)
    k = STEPS if method.fit is Fit.ALL_STEPS else 3
    two_inputs = replace(method, inputs=InputNames(("observation", "action")))
    spec = replace(observation_spec(1, method, settings, STEPS, AGENTS), method=two_inputs, action_size=1)
    order = np.sort(rng.permuted(np.tile(np.arange(STEPS), (n_updates, n_episodes, 1)), axis=2)[..., :k])
    batches = whole_batches(rows[np.arange(n_episodes)[:, None], order], reward.mean(axis=(1, 2)), STEPS)
    state = observed_state(spec, flat, batches.mean_reward[0], batches.length[0], KEY)
    state, losses = fit_batches(state, batches, spec)
    assert float(losses[-5:].mean()) < float(losses[:5].mean())
    if method.decoder in ("step", "lrr"):
        assert np.corrcoef(np.ravel(decoder_rewards(state, flat, spec)), reward.ravel())[0, 1] > 0.9
