"""Diaster against a slow NumPy twin, and what it must learn."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.decoder_toys import check_padding, loss_gradient, make_decoder, train_by_loss
from helpers.numpy_attention import numpy_linear

EPISODES, STEPS, FEATURES = 4, 7, 3
LENGTH = np.array([7, 4, 2, 1])


@pytest.fixture(scope="module")
def decoder():
    return make_decoder("diaster", FEATURES, STEPS, hidden=(5,))


@pytest.fixture(scope="module")
def rows():
    return np.random.default_rng(0).normal(size=(EPISODES, STEPS, FEATURES)).astype(np.float32)


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


def test_piece_rewards_against_numpy(decoder, rows):
    begins = np.zeros((EPISODES, STEPS), bool)
    begins[0, 3] = begins[2, 1] = True
    rewards = np.asarray(jax.jit(lambda *args: decoder.piece_rewards(*args))(rows, begins))
    for episode, step in np.ndindex(rewards.shape):
        begin = max([0, *(b for b in np.flatnonzero(begins[episode]) if b <= step)])
        want = numpy_piece_reward(decoder, rows[episode, begin : step + 1])
        assert rewards[episode, step] == pytest.approx(want, rel=1e-4, abs=1e-5)


def test_loss_against_numpy(decoder, rows):
    """The last episode has a single step, so that it cannot be cut. The third is padding."""
    key, target = jax.random.key(5), np.array([1.0, -0.5, 2.0, 0.3], np.float32)
    mask = np.array([1.0, 1, 0, 1], np.float32)
    cuts = np.asarray(jax.random.randint(key, (EPISODES,), 1, jnp.maximum(jnp.asarray(LENGTH), 2)))
    want = 0.0
    for x, length, mean_reward, valid, cut in zip(rows, LENGTH, target, mask, cuts, strict=True):
        total = mean_reward * length / STEPS
        second = numpy_piece_reward(decoder, x[cut:length]) if length > 1 else 0.0
        prefix = [numpy_piece_reward(decoder, x[: t + 1]) for t in range(length)]
        prefix[-1] = total
        r_hat = np.asarray(decoder(jnp.asarray(x[:length]), None).r_hat)
        step_loss = np.mean((r_hat - STEPS * np.diff(prefix, prepend=0)) ** 2)
        want += valid * ((numpy_piece_reward(decoder, x[:cut]) + second - total) ** 2 + step_loss)
    loss = decoder.loss(*map(jnp.asarray, (rows, LENGTH, target, mask)), key)
    assert float(loss) == pytest.approx(want / 3, rel=1e-3)


def test_gradient_ignores_padding_and_the_step_model_does_not_train_the_other(decoder, rows):
    larger = eqx.tree_at(lambda d: d.step_model, decoder, jax.tree.map(lambda leaf: 100 * leaf, decoder.step_model))
    pair = check_padding(decoder, rows, LENGTH).gru, loss_gradient(larger, rows, LENGTH).gru
    for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_must_learn_step_rewards():
    """Step rewards are linear in the features. Only returns are observed."""
    rng, weight = np.random.default_rng(1), np.array([1.0, -2.0, 0.5], np.float32)
    x = rng.normal(size=(600, 32, STEPS, FEATURES)).astype(np.float32)
    decoder = make_decoder("diaster", FEATURES, STEPS, hidden=(32,))
    decoder = train_by_loss(decoder, x, (x @ weight).mean(axis=-1), 1e-2)
    x = rng.normal(size=(500, FEATURES)).astype(np.float32)
    assert np.corrcoef(decoder(jnp.asarray(x), None).r_hat, x @ weight)[0, 1] > 0.9
