import math

import jax
import jax.numpy as jnp
import numpy as np

from helpers.numpy_attention import numpy_attention, numpy_layer_norm, numpy_linear
from lare_rl.credit.stas import STAS, Coalitions, TimeLayer, dropout

STEPS, AGENTS = 5, 3
KEY = jax.random.key(1)


def test_time_layer_against_numpy():
    """Its input is not added again after the feed-forward layers, and the attention is added twice."""
    layer = TimeLayer(key=KEY)
    x = np.random.default_rng(0).normal(size=(STEPS, 128)).astype(np.float32)
    projected = [numpy_linear(linear, x).reshape(STEPS, 4, 32) for linear in (layer.query, layer.key, layer.value)]
    a = numpy_linear(layer.merge, numpy_attention(*projected, np.tri(STEPS, dtype=bool)))
    hidden = numpy_linear(layer.feed_forward.layers[0], numpy_layer_norm(x + a, 1e-12))
    hidden *= 0.5 * (1 + np.vectorize(math.erf)(hidden / np.sqrt(2)))
    want = numpy_layer_norm(numpy_linear(layer.feed_forward.layers[1], hidden) + 2 * a, 1e-12)
    np.testing.assert_allclose(layer(jnp.asarray(x), None), want, rtol=1e-3, atol=1e-4)


def test_coalitions_against_numpy():
    """The output is the mean over coalitions of attention, for which each agent has its own queries."""
    layer, key = Coalitions(AGENTS, key=KEY), jax.random.key(1)
    x = np.random.default_rng(0).normal(size=(AGENTS, 128)).astype(np.float32)
    query = np.stack([x[i] @ layer.query.weight[i] + layer.query.bias[i] for i in range(AGENTS)])
    projected = query, numpy_linear(layer.key, x), numpy_linear(layer.value, x)
    projected = [values.reshape(AGENTS, 4, 32) for values in projected]
    masks = np.asarray(jax.random.bernoulli(key, 0.5, (5, AGENTS, AGENTS))) | np.eye(AGENTS, dtype=bool)
    want = np.mean([numpy_linear(layer.merge, numpy_attention(*projected, mask)) for mask in masks], axis=0)
    np.testing.assert_allclose(layer(jnp.asarray(x), key, None), want, rtol=1e-4, atol=1e-5)


def test_dropout_is_independent_for_each_entry():
    output = np.asarray(dropout(jnp.ones((50, 20, 13)), KEY))
    assert set(np.unique(output)) == {0, 2}
    assert np.abs(output.mean(axis=0) - 1).max() < 0.75  # over 50: 5 standard deviations
    assert np.abs(np.corrcoef(output.reshape(-1, 13).T) - np.eye(13)).max() < 0.2
    np.testing.assert_array_equal(dropout(jnp.ones(3), None), 1)


def test_reward_is_a_mean_over_samples():
    """It is nearer to the mean over many samples than a single sample."""
    decoder = STAS(6, STEPS, AGENTS, 2.0, key=KEY)
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
