"""RUDDER against a slow NumPy twin, and what it must learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.decoder_toys import check_padding, make_decoder, train_by_loss
from helpers.numpy_attention import numpy_linear

EPISODES, STEPS, FEATURES = 4, 7, 3
LENGTH = np.array([7, 4, 2, 1])


@pytest.fixture(scope="module")
def decoder():
    return make_decoder("rudder", FEATURES, STEPS, hidden=(5,))


@pytest.fixture(scope="module")
def rows():
    return np.random.default_rng(0).normal(size=(EPISODES, STEPS, FEATURES)).astype(np.float32)


def numpy_predictions(decoder, rows):
    """Return g after each step, computed one step after the other."""
    h, g = np.zeros(5), []
    for x in rows:
        gate = 1 / (1 + np.exp(-numpy_linear(decoder.input_gate, h)))
        h = h + gate * np.tanh(numpy_linear(decoder.cell_input, x))
        g.append(numpy_linear(decoder.readout, h / STEPS)[0])
    return np.array(g)


def test_predictions_against_numpy(decoder, rows):
    predictions = jax.jit(lambda rows: decoder.predictions(rows))(rows)
    for x, g in zip(rows, predictions, strict=True):
        np.testing.assert_allclose(g, numpy_predictions(decoder, x), rtol=1e-4, atol=1e-5)


def test_loss_against_numpy(decoder, rows):
    """The rewards of an episode add up to its return. The third episode is padding."""
    target, mask = np.array([1.0, -0.5, 2.0, 0.3], np.float32), np.array([1.0, 1, 0, 1], np.float32)
    want = 0.0
    for x, length, mean_reward, valid in zip(rows, LENGTH, target, mask, strict=True):
        total = mean_reward * length / STEPS
        g = numpy_predictions(decoder, x[:length])
        reward = np.diff(g, prepend=0) + (total - g[-1]) / length
        assert reward.sum() == pytest.approx(total)
        r_hat = np.asarray(decoder(jnp.asarray(x[:length]), None).r_hat)
        return_loss = (g[-1] - total) ** 2 + 0.5 * np.mean((g - total) ** 2)
        want += valid * (return_loss + np.mean((r_hat - STEPS * reward) ** 2))
    loss = jax.jit(lambda *args: decoder.loss(*args))(rows, jnp.asarray(LENGTH), target, mask, jax.random.key(0))
    assert float(loss) == pytest.approx(want / 3, rel=1e-3)


def test_gradient_ignores_padding(decoder, rows):
    check_padding(decoder, rows, LENGTH)


def test_must_learn_step_rewards_and_a_cause_in_the_past():
    """Step rewards are linear in the features, and the sign of the first step's last feature decides about those of the second.

    The step model learns the mean over that sign, and the differences of predictions the sign, too.
    """
    rng, weight = np.random.default_rng(1), np.array([1.0, 0, 0.5], np.float32)
    x = rng.normal(size=(600, 32, STEPS, FEATURES)).astype(np.float32)
    rewards = x @ weight + np.sign(x[..., :1, 2]) * x[..., 1]
    decoder = train_by_loss(make_decoder("rudder", FEATURES, STEPS, hidden=(32,)), x, rewards.mean(axis=-1), 1e-2)
    x = rng.normal(size=(100, STEPS, FEATURES)).astype(np.float32)
    r_hat = np.asarray(decoder(jnp.asarray(x), None).r_hat)
    assert np.corrcoef(r_hat.ravel(), (x @ weight).ravel())[0, 1] > 0.9
    differences = np.diff(decoder.predictions(jnp.asarray(x)), axis=1, prepend=0)
    past_effect = np.sign(x[:, :1, 2]) * x[..., 1]
    assert np.corrcoef(differences[:, 1:].ravel(), past_effect[:, 1:].ravel())[0, 1] > 0.4
