"""RBT against a slow NumPy twin, what it must learn, and what it refuses."""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_attention import numpy_attention, numpy_layer_norm, numpy_linear
from lare_rl.config.validity import check_credit
from lare_rl.credit import rbt
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.credit.rbt import RBT
from lare_rl.errors import LareError
from lare_rl.nn.networks import adam_step, init_adam
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule

BAGS, STEPS, STATES, ACTIONS, SIZE = 4, 5, 3, 2, 8
LENGTH = np.array([5, 4, 2, 1])


@pytest.fixture(scope="module")
def decoder():
    return RBT(STATES, ACTIONS, (SIZE,), key=jax.random.key(0))


@pytest.fixture(scope="module")
def rows():
    return np.random.default_rng(0).normal(size=(BAGS, STEPS, 2 * STATES + ACTIONS)).astype(np.float32)


def numpy_norm(layer, x):
    return numpy_layer_norm(x, 1e-5) * np.asarray(layer.weight) + np.asarray(layer.bias)


def numpy_mlp(mlp, x):
    first, second = mlp.layers
    return numpy_linear(second, np.maximum(numpy_linear(first, x), 0))


def numpy_bag(decoder, bag):
    """Return the rewards of the steps of one bag, and the predicted next states."""
    position = [
        [np.sin(t / 1e4 ** (i / SIZE)) if i % 2 == 0 else np.cos(t / 1e4 ** ((i - 1) / SIZE)) for i in range(SIZE)]
        for t in range(len(bag))
    ]
    state, action, _ = np.split(bag, [STATES, STATES + ACTIONS], axis=-1)
    x = np.zeros((2 * len(bag), SIZE))
    x[::2] = numpy_linear(decoder.embed_action, action) + position
    x[1::2] = numpy_linear(decoder.embed_state, state) + position
    x = numpy_norm(decoder.first_norm, x)
    for block in decoder.blocks:
        projected = np.split(numpy_linear(block.projections, numpy_norm(block.norms[0], x)), 3, axis=-1)
        attention = numpy_attention(*(values[:, None] for values in projected), np.tri(len(x), dtype=bool))
        x = x + numpy_linear(block.merge, attention)
        x = x + numpy_mlp(block.feed_forward, numpy_norm(block.norms[1], x))
    x = numpy_norm(decoder.last_norm, x)
    query, key, value = np.split(numpy_linear(decoder.bag_attention, x[1::2]), [SIZE, 2 * SIZE], axis=-1)
    weight = np.exp(query @ key.T / np.sqrt(SIZE))
    return (weight / weight.sum(axis=1, keepdims=True) @ value)[:, 0], numpy_linear(decoder.next_state, x[::2])


def test_loss_against_numpy(decoder, rows, monkeypatch):
    """The third bag is padding."""
    monkeypatch.setattr(rbt, "DROPOUT", 0.0)
    target, mask = np.array([1.0, -0.5, 2.0, 0.3], np.float32), np.array([1.0, 1, 0, 1], np.float32)
    want = 0.0
    for bag, length, mean_reward, valid in zip(rows, LENGTH, target, mask, strict=True):
        steps = bag[:length]
        reward, next_state = numpy_bag(decoder, steps)
        r_hat = numpy_mlp(decoder.step_model, steps[:, : STATES + ACTIONS])[:, 0]
        reward_loss = (reward.sum() - length * mean_reward) ** 2 / length
        state_loss = np.mean((next_state - steps[:, STATES + ACTIONS :]) ** 2)
        want += valid * (reward_loss + state_loss + np.mean((r_hat - reward) ** 2))
    loss = jax.jit(lambda *args: decoder.loss(*args))(rows, jnp.asarray(LENGTH), target, mask, jax.random.key(0))
    assert float(loss) == pytest.approx(want / 3, rel=1e-3)


def test_a_tenth_is_dropped():
    x = jnp.ones((100, 200))
    output = np.asarray(rbt._dropout(x, jax.random.key(0)))
    assert np.mean(output == 0) == pytest.approx(0.1, abs=0.02)
    np.testing.assert_allclose(output[output > 0], 1 / 0.9, rtol=1e-5)
    np.testing.assert_array_equal(rbt._dropout(x, None), x)


def test_gradient_ignores_padding(decoder, rows, monkeypatch):
    monkeypatch.setattr(rbt, "DROPOUT", 0.0)

    @jax.jit
    def gradient(rows):
        args = rows, jnp.asarray(LENGTH), jnp.ones(BAGS), jnp.ones(BAGS), jax.random.key(1)
        return jax.grad(lambda decoder: decoder.loss(*args))(decoder)

    padded = np.where(np.arange(STEPS)[:, None] < LENGTH[:, None, None], rows, np.float32(9.0))
    for a, b in zip(*map(jax.tree.leaves, (gradient(rows), gradient(padded))), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_must_learn_rewards_and_next_states():
    """Rewards are linear in state and action. The next state is the action."""
    rng, weight = np.random.default_rng(1), np.array([1.0, 0, 0.5, -1.0, 0], np.float32)
    decoder = RBT(STATES, ACTIONS, (16,), key=jax.random.key(0))
    x = rng.normal(size=(500, 32, STEPS, STATES + ACTIONS)).astype(np.float32)
    rows = np.concatenate([x, x[..., -1:].repeat(STATES, axis=-1)], axis=-1)
    reward, length = x @ weight, jnp.full(32, STEPS)

    def body(state, inputs):
        (decoder, optimizer), (rows, target, key) = state, inputs
        gradient = jax.grad(lambda d: d.loss(rows, length, target, jnp.ones(32), key))(decoder)
        return adam_step(decoder, gradient, optimizer, 5e-3), None

    @jax.jit
    def train(decoder, *inputs):
        decoder = jax.lax.scan(body, (decoder, init_adam(decoder, 5e-3)), inputs)[0][0]
        last = jnp.asarray(rows[0])
        return decoder(last, None).r_hat, decoder.bag_rewards(last, jnp.ones(last.shape[:2], bool), None)[1]

    keys = jax.random.split(jax.random.key(0), len(rows))
    r_hat, next_state = map(np.asarray, train(decoder, rows, reward.mean(axis=-1), keys))
    assert np.corrcoef(r_hat.ravel(), reward[0].ravel())[0, 1] > 0.6
    assert np.corrcoef(next_state[..., 0].ravel(), x[0, ..., -1].ravel())[0, 1] > 0.9


def test_long_payments_are_refused(decoder):
    with pytest.raises(LareError, match=r"at most 512 steps .* 600: use rudder"):
        decoder.loss(jnp.zeros((1, 600, 8)), jnp.array([600]), jnp.ones(1), jnp.ones(1), jax.random.key(0))


@pytest.mark.parametrize(
    ("payments", "max_steps", "words"),
    [
        (PAID_AT_END, 1000, "at most 512 steps .* 1000: use rudder, or payments"),
        (PaymentRule(window=600), 1000, "up to 600"),
        (PaymentRule(period=50), 1000, None),
        (PAID_AT_END, None, None),
    ],
)
def test_length_of_payments(payments, max_steps, words):
    sizes = {"n_agents": 1, "n_raw_features": 5, "max_steps": max_steps}
    with nullcontext() if words is None else pytest.raises(LareError, match=words):
        check_credit(METHODS["rbt"], CreditSettings(), payments=payments, **sizes)
