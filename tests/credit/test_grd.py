import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.decoder_toys import MASK, TARGET, make_decoder, random_rows, train_by_loss
from helpers.numpy_attention import numpy_mlp
from lare_rl.credit import grd, input_names, methods
from lare_rl.credit.grd import causes, sample_mask
from lare_rl.errors import LareError

EPISODES, STEPS, STATES, ACTIONS = 4, 6, 3, 2
LENGTH = np.array([6, 4, 2, 1])
ROWS = random_rows(EPISODES, STEPS, 2 * STATES + ACTIONS)
LAMBDAS = (0.1, 0.2, 0.3, 0.4, 0.5)
KEY = jax.random.key(0)
SIZES = {"observation": STATES, "action": ACTIONS, "next_observation": STATES}


@pytest.fixture(scope="module")
def decoder():
    return make_decoder("grd", SIZES, STEPS, hidden=(5,), sparsity=LAMBDAS)


def numpy_log_density(decoder, row, state_mask, action_mask):
    """Return log p of each entry of the next state of one step, one entry after the other."""
    state, action, next_state = np.split(row.astype(float), [STATES, STATES + ACTIONS])
    log_densities = []
    for i in range(STATES):
        output = numpy_mlp(decoder.dynamics, np.concatenate([state * state_mask[:, i], action * action_mask[:, i]]))
        weight, mean, std = np.exp(output[:3]), output[3:6], np.exp(5 * np.tanh(output[6:] / 5))
        density = np.exp(-(((next_state[i] - mean) / std) ** 2) / 2) / (std * np.sqrt(2 * np.pi))
        log_densities.append(np.log(weight / weight.sum() @ density))
    return np.array(log_densities)


def negative_log_absence(logits):
    """Return the mean of -log P(C = 0): the cross entropy of two classes, of which the second one is the label."""
    probability = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    return -np.log(probability[..., 1]).mean()


@pytest.mark.parametrize("threshold", [0.0, 1e9])
def test_loss_against_numpy(decoder, threshold, monkeypatch):
    """The third episode is padding. Below the threshold of a loss, sparsity counts."""
    monkeypatch.setattr(grd, "REWARD_THRESHOLD", threshold)
    monkeypatch.setattr(grd, "DYNAMICS_THRESHOLD", threshold)
    keys = jax.random.split(KEY, 5)
    logits = decoder.state_reward, decoder.action_reward, decoder.state_state, decoder.action_state
    masks = [np.asarray(sample_mask(*pair)) for pair in zip(logits, (keys[0], keys[1], keys[3], keys[4]), strict=True)]
    causes_of_reward = np.concatenate(masks[:2])
    errors = []
    for i in (0, 1, 3):
        r_hat = [
            numpy_mlp(decoder.reward_model, causes_of_reward * x[: STATES + ACTIONS])[0] for x in ROWS[i, : LENGTH[i]]
        ]
        errors.append((np.mean(r_hat) - TARGET[i]) ** 2)
    valid = (np.arange(STEPS) < LENGTH[:, None]) & (MASK > 0)[:, None]
    row_index = jax.random.choice(keys[2], EPISODES * STEPS, (256,), p=valid.ravel() / valid.sum())
    log_density = np.mean(
        [numpy_log_density(decoder, ROWS.reshape(-1, 8)[i], *masks[2:]) for i in np.asarray(row_index)]
    )
    want = np.mean(errors) - log_density
    if threshold:
        itself, ss = np.eye(STATES, dtype=bool), np.asarray(decoder.state_state)
        groups = decoder.state_reward, decoder.action_reward, ss[~itself], ss[itself], decoder.action_state
        want += sum(lam * negative_log_absence(np.asarray(group)) for lam, group in zip(LAMBDAS, groups, strict=True))
    loss = jax.jit(lambda *args: decoder.loss(*args))(ROWS, jnp.asarray(LENGTH), TARGET, MASK, KEY)
    assert float(loss) == pytest.approx(want, rel=1e-4)


def test_rewards_of_causes_and_loss_without_episodes(decoder):
    mask = np.concatenate([causes(decoder.state_reward), causes(decoder.action_reward)])
    assert 0 < mask.sum() < STATES + ACTIONS
    want = numpy_mlp(decoder.reward_model, mask * ROWS[..., : STATES + ACTIONS])[..., 0]
    np.testing.assert_allclose(decoder(jnp.asarray(ROWS), None).r_hat, want, rtol=1e-4, atol=1e-5)
    args = jnp.asarray(ROWS), jnp.asarray(LENGTH), jnp.ones(EPISODES), jnp.zeros(EPISODES), KEY
    loss, gradient = jax.jit(jax.value_and_grad(lambda decoder: decoder.loss(*args)))(decoder)
    assert float(loss) == pytest.approx(
        0.1 * negative_log_absence(decoder.state_reward) + 0.2 * negative_log_absence(decoder.action_reward)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_samples_of_masks():
    """They are 0 or 1, with the probabilities of a softmax. The gradient is that of the soft sample."""
    logits = jnp.array([[1.0, 0.0], [-2.0, 0.5]])
    samples = np.asarray(jax.vmap(lambda key: sample_mask(logits, key))(jax.random.split(KEY, 4000)))
    assert set(np.unique(np.round(samples, 6))) == {0, 1}
    np.testing.assert_allclose(samples.mean(axis=0), 1 / (1 + np.exp([-1, 2.5])), atol=0.03)
    near = jnp.array([-float(jax.random.logistic(KEY, (1,))[0]) + 0.002, 0.0])[None]  # (d + noise) / 0.01 = 0.2
    gradient = jax.grad(lambda logits: sample_mask(logits, KEY)[0])(near)
    soft = 1 / (1 + np.exp(-0.2))
    np.testing.assert_allclose(gradient[0], [soft * (1 - soft) / 0.01, -soft * (1 - soft) / 0.01], rtol=1e-2)


def test_must_learn_causes(monkeypatch):
    """The reward is caused by the first entries of state and action, and the next state by the second ones."""
    monkeypatch.setattr(grd, "DYNAMICS_STEPS", 32)
    monkeypatch.setattr(grd, "REWARD_THRESHOLD", np.inf)  # a network that ignores an entry does not need its mask
    monkeypatch.setattr(grd, "DYNAMICS_THRESHOLD", np.inf)
    decoder = make_decoder("grd", SIZES, STEPS, hidden=(16,), sparsity=(0.03,) * 5)
    x = np.random.default_rng(1).normal(size=(1000, 16, STEPS, STATES + ACTIONS)).astype(np.float32)
    reward = 2 * x[..., 0] - x[..., STATES]
    rows = np.concatenate([x, np.repeat(x[..., 1:2] + x[..., STATES + 1 : STATES + 2], STATES, axis=-1)], axis=-1)
    decoder = train_by_loss(decoder, rows, reward.mean(axis=-1), 1e-2)
    assert causes(decoder.state_reward).tolist() == [True, False, False]
    assert causes(decoder.action_reward).tolist() == [True, False]
    r_hat = np.asarray(decoder(jnp.asarray(rows[0]), None).r_hat)
    assert np.corrcoef(r_hat.ravel(), reward[0].ravel())[0, 1] > 0.9
    from_state, from_action = causes(decoder.state_state), causes(decoder.action_state)
    assert not from_state[::2].any()
    assert not from_action[0].any()
    assert from_state[1].any()
    assert from_action[1].any()


def test_input_sizes_and_order():
    with pytest.raises(LareError, match=r"reads the inputs observation, action, next_observation, .*'action': 2"):
        make_decoder("grd", {"action": 2, "observation": 3, "next_observation": 3}, STEPS)
    sizes = {"observation": 3, "action": 2, "factors": 4}
    names = methods.TRANSITION.resolve()
    assert input_names.input_sizes(names, sizes) == (("observation", 3), ("action", 2), ("next_observation", 3))
    assert input_names.input_sizes(("factors", "history"), sizes) == (("factors", 4), ("history", 12))
