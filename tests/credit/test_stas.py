import jax
import jax.numpy as jnp
import numpy as np

from helpers.decoder_toys import make_decoder
from helpers.numpy_attention import numpy_coalitions, numpy_time_layer
from lare_rl.credit.stas import Coalitions, TimeLayer, dropout

STEPS, AGENTS = 5, 3
KEY = jax.random.key(1)


def test_layers_against_numpy():
    rng = np.random.default_rng(0)
    steps, agents = (rng.normal(size=(n, 128)).astype(np.float32) for n in (STEPS, AGENTS))
    layer = TimeLayer(key=KEY)
    np.testing.assert_allclose(layer(jnp.asarray(steps), None), numpy_time_layer(layer, steps), rtol=1e-3, atol=1e-4)
    layer = Coalitions(AGENTS, key=KEY)
    masks = np.asarray(jax.random.bernoulli(KEY, 0.5, (5, AGENTS, AGENTS))) | np.eye(AGENTS, dtype=bool)
    want = numpy_coalitions(layer, agents, masks)
    np.testing.assert_allclose(layer(jnp.asarray(agents), KEY, None), want, rtol=1e-4, atol=1e-5)


def test_dropout_is_independent_for_each_entry():
    output = np.asarray(dropout(jnp.ones((50, 20, 13)), KEY))
    assert set(np.unique(output)) == {0, 2}
    assert np.abs(output.mean(axis=0) - 1).max() < 0.75  # over 50: 5 standard deviations
    assert np.abs(np.corrcoef(output.reshape(-1, 13).T) - np.eye(13)).max() < 0.2
    np.testing.assert_array_equal(dropout(jnp.ones(3), None), 1)


def test_reward_is_a_mean_over_samples():
    """It is nearer to the mean over many samples than a single sample."""
    decoder = make_decoder("stas", 6, STEPS, AGENTS, seed=1)
    rows = np.random.default_rng(0).normal(size=(2 * STEPS, AGENTS, 6)).astype(np.float32)

    @jax.jit
    def compute(rows):
        x = jnp.swapaxes(decoder.embed(rows).reshape(2, STEPS, AGENTS, 128), 1, 2) + decoder.position
        for layer in decoder.layers:
            x = layer(x, None)
        x, keys = jnp.swapaxes(x, 1, 2), jax.random.split(jax.random.key(5), 60)
        return decoder(rows, None).r_hat, jax.lax.map(lambda key: decoder.agent_rewards(x, key, None), keys)

    r_hat, samples = map(np.asarray, compute(rows))
    errors = samples - samples.mean(axis=0)
    assert np.abs(r_hat.reshape(errors.shape[1:]) - samples.mean(axis=0)).mean() < 0.6 * np.abs(errors).mean()
