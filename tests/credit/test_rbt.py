from contextlib import nullcontext

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import check_loss, make_decoder, random_rows, train_by_loss
from helpers.numpy_attention import numpy_attention, numpy_layer_norm, numpy_linear, numpy_mlp
from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.config.validity import check_credit
from lare_rl.credit import rbt
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.tasks.payments import PAID_AT_END, PaymentRule

STEPS, STATES, ACTIONS, SIZE = 5, 3, 2, 8
SIZES = {"observation": STATES, "action": ACTIONS, "next_observation": STATES}


def numpy_norm(layer, x):
    return numpy_layer_norm(x, 1e-5) * np.asarray(layer.weight) + np.asarray(layer.bias)


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


def test_loss_against_numpy(monkeypatch):
    monkeypatch.setattr(rbt, "DROPOUT", 0.0)
    decoder = make_decoder("rbt", SIZES, STEPS, hidden=(SIZE,))

    def bag_loss(steps, mean_reward, _):
        reward, next_state = numpy_bag(decoder, steps)
        r_hat = numpy_mlp(decoder.step_model, steps[:, : STATES + ACTIONS])[:, 0]
        reward_loss = (reward.sum() - len(steps) * mean_reward) ** 2 / len(steps)
        state_loss = np.mean((next_state - steps[:, STATES + ACTIONS :]) ** 2)
        return reward_loss + state_loss + np.mean((r_hat - reward) ** 2)

    check_loss(decoder, random_rows(4, STEPS, 2 * STATES + ACTIONS), [5, 4, 2, 1], bag_loss)


@pytest.mark.long
def test_must_learn_rewards_and_next_states(monkeypatch):
    """Rewards are linear in state and action. The next state is the action. Three layers take seconds to compile."""
    monkeypatch.setattr(rbt, "LAYERS", 1)
    rng, weight = np.random.default_rng(1), np.array([1.0, 0, 0.5, -1.0, 0], np.float32)
    x = rng.normal(size=(500, 32, STEPS, STATES + ACTIONS)).astype(np.float32)
    rows = np.concatenate([x, x[..., -1:].repeat(STATES, axis=-1)], axis=-1)
    reward = x @ weight
    decoder = train_by_loss(make_decoder("rbt", SIZES, STEPS, hidden=(16,)), rows, reward.mean(axis=-1), 5e-3)
    last = jnp.asarray(rows[0])
    r_hat = np.asarray(decoder(last, None).r_hat)
    next_state = np.asarray(decoder.bag_rewards(last, jnp.ones(last.shape[:2], bool), None)[1])
    assert np.corrcoef(r_hat.ravel(), reward[0].ravel())[0, 1] > 0.6
    assert np.corrcoef(next_state[..., 0].ravel(), x[0, ..., -1].ravel())[0, 1] > 0.9


def test_length_of_payments():
    for payments, max_steps, words in (
        (PAID_AT_END, 1000, "at most 512 steps .* 1000: use rudder, or payments"),
        (PaymentRule(window=600), 1000, "up to 600"),
        (PaymentRule(period=50), 1000, None),
        (PAID_AT_END, 512, None),
    ):
        spec = observation_spec(STATES, METHODS["rbt"], CreditSettings(), max_steps, payments=payments)
        with nullcontext() if words is None else pytest.raises(LareError, match=words):
            check_credit(spec, 1)
    credit, rows = CreditAssigner("rbt", observation_space=1, action_space=1), np.zeros((600, 1))
    with pytest.raises(LareError, match=r"at most 512 steps .* 600: use rudder"):
        credit.add_episode(rows, rows, rows, 1.0)
    assert not credit.store.episodes
