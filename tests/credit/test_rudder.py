import jax.numpy as jnp
import numpy as np
import pytest

from helpers.decoder_toys import check_loss, make_decoder, random_rows, train_by_loss
from helpers.numpy_attention import numpy_linear

STEPS, FEATURES = 7, 3


def numpy_predictions(decoder, rows):
    """Return g after each step, computed one step after the other."""
    h, g = np.zeros(5), []
    for x in rows:
        gate = 1 / (1 + np.exp(-numpy_linear(decoder.input_gate, h)))
        h = h + gate * np.tanh(numpy_linear(decoder.cell_input, x))
        g.append(numpy_linear(decoder.readout, h / STEPS)[0])
    return np.array(g)


def test_loss_against_numpy():
    """The rewards of an episode add up to its return."""
    decoder = make_decoder("rudder", FEATURES, STEPS, hidden=(5,))

    def episode_loss(x, mean_reward, _):
        total, g = mean_reward * len(x) / STEPS, numpy_predictions(decoder, x)
        reward = np.diff(g, prepend=0) + (total - g[-1]) / len(x)
        assert reward.sum() == pytest.approx(total)
        step_error = decoder(jnp.asarray(x), None).r_hat - STEPS * reward
        return (g[-1] - total) ** 2 + 0.5 * np.mean((g - total) ** 2) + np.mean(step_error**2)

    check_loss(decoder, random_rows(4, STEPS, FEATURES), [7, 4, 2, 1], episode_loss)


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
