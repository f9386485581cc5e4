import jax
import jax.numpy as jnp
import numpy as np

from helpers.decoder_toys import make_decoder

STEPS, AGENTS = 5, 3
KEY = jax.random.key(1)


def test_mean_over_samples():
    # It is nearer to the mean over many samples than a single sample.
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
