import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from helpers.decoder_toys import MASK, TARGET, check_loss, make_decoder, random_rows, train_by_loss
from helpers.numpy_attention import numpy_linear

STEPS, FEATURES, LENGTH = 7, 3, np.array([7, 4, 2, 1])
KEY, ROWS = jax.random.key(5), random_rows(4, STEPS, FEATURES)


def small_decoder():
    return make_decoder("diaster", FEATURES, STEPS, hidden=(5,))


def numpy_piece_reward(decoder, rows):
    """Return F of some steps, computed one step after the other."""

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    h = np.zeros(5)
    for x in rows:
        u, w = numpy_linear(decoder.gru.input_projection, x), numpy_linear(decoder.gru.hidden_projection, h)
        z, r = sigmoid(u[:5] + w[:5]), sigmoid(u[5:10] + w[5:10])
        h = (1 - z) * np.tanh(u[10:] + r * w[10:]) + z * h
    return float(numpy_linear(decoder.readout, h)[0])


def test_loss_against_numpy():
    """The last episode has a single step, so that it cannot be cut."""
    decoder = small_decoder()
    cuts = np.asarray(jax.random.randint(KEY, (4,), 1, np.maximum(LENGTH, 2)))

    def episode_loss(x, mean_reward, i):
        total = mean_reward * len(x) / STEPS
        second = numpy_piece_reward(decoder, x[cuts[i] :]) if len(x) > 1 else 0.0
        prefix = [*(numpy_piece_reward(decoder, x[: t + 1]) for t in range(len(x) - 1)), total]
        step_error = decoder(jnp.asarray(x), None).r_hat - STEPS * np.diff(prefix, prepend=0)
        return (numpy_piece_reward(decoder, x[: cuts[i]]) + second - total) ** 2 + np.mean(step_error**2)

    check_loss(decoder, ROWS, LENGTH, episode_loss, KEY)


def test_step_model_does_not_train_the_other():
    args = *map(jnp.asarray, (ROWS, LENGTH, TARGET, MASK)), KEY

    @jax.jit
    def gradient(decoder):
        return jax.grad(lambda decoder: decoder.loss(*args))(decoder).gru

    decoder = small_decoder()
    larger = eqx.tree_at(lambda d: d.step_model, decoder, jax.tree.map(lambda leaf: 100 * leaf, decoder.step_model))
    for a, b in zip(*map(jax.tree.leaves, (gradient(decoder), gradient(larger))), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_must_learn_step_rewards():
    """Step rewards are linear in the features. Only returns are observed."""
    rng, weight = np.random.default_rng(1), np.array([1.0, -2.0, 0.5], np.float32)
    x = rng.normal(size=(600, 32, STEPS, FEATURES)).astype(np.float32)
    decoder = make_decoder("diaster", FEATURES, STEPS, hidden=(32,))
    decoder = train_by_loss(decoder, x, (x @ weight).mean(axis=-1), 1e-2)
    x = rng.normal(size=(500, FEATURES)).astype(np.float32)
    assert np.corrcoef(decoder(jnp.asarray(x), None).r_hat, x @ weight)[0, 1] > 0.9
