from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import decoder_rewards, fit_batches, make_decoder, observed_state, whole_batches
from helpers.numpy_attention import numpy_coalitions, numpy_gelu, numpy_linear, numpy_mlp, numpy_time_layer
from lare_rl.config.validity import check_credit
from lare_rl.credit import decoder_state
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.credit.rewards import StepBatch, training_rewards
from lare_rl.credit.tar2 import return_shares
from lare_rl.errors import LareError

EPISODES, STEPS, AGENTS, OBSERVATIONS, ACTIONS = 2, 4, 3, 5, 2
KEY = jax.random.key(1)
shares_of = jax.jit(return_shares)


def numpy_output(decoder, episode, key):
    """Return the contributions and the log probability of each action, of one episode (steps, agents, inputs)."""
    observation, action = np.split(episode, [OBSERVATIONS], axis=-1)
    state = numpy_linear(decoder.embed_observation, observation) + np.asarray(decoder.position)[:, None]
    x, outputs = state + numpy_linear(decoder.embed_action, action), []
    for i, layer_key in enumerate(jax.random.split(key, 3)):
        mask_key, order_key = jax.random.split(layer_key)
        x = np.stack([numpy_time_layer(decoder.time_layers[i], x[:, agent]) for agent in range(AGENTS)], axis=1)
        x = x + np.asarray(decoder.index_embeddings)[i][np.asarray(jax.random.permutation(order_key, AGENTS))]
        masks = np.asarray(jax.random.bernoulli(mask_key, 0.5, (5, AGENTS, AGENTS))) | np.eye(AGENTS, dtype=bool)
        x = np.stack([numpy_coalitions(decoder.agent_layers[i], step, masks) for step in x])
        outputs.append(x)
    h = np.concatenate(outputs, axis=-1)
    outcome = np.broadcast_to(h[-1].mean(axis=0), h.shape)
    contributions = numpy_mlp(decoder.contribution_model, np.concatenate([h, outcome], axis=-1), numpy_gelu)[..., 0]
    past = np.concatenate([np.zeros_like(h[:1]), h[:-1]])
    mean_state = np.broadcast_to(state.mean(axis=1, keepdims=True), state.shape)
    logits = numpy_mlp(decoder.action_model, np.concatenate([mean_state, past], axis=-1), numpy_gelu)
    log_p = logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))
    return contributions, (log_p * action).sum(axis=-1)


def test_output_against_numpy():
    """Without a key, contributions are a mean over samples, and actions have no penalty."""
    decoder = make_decoder("tar2", {"observation": OBSERVATIONS, "action": ACTIONS}, STEPS, AGENTS)
    rng = np.random.default_rng(0)
    action = np.eye(ACTIONS)[rng.integers(ACTIONS, size=(EPISODES * STEPS, AGENTS))]
    observation = rng.normal(size=(EPISODES * STEPS, AGENTS, OBSERVATIONS))
    rows = np.concatenate([observation, action], axis=-1).astype(np.float32)
    keys = jax.random.split(jax.random.key(jnp.uint32(0)), 8)
    compute = jax.jit(lambda rows: (decoder(rows, None), jax.lax.map(lambda key: decoder(rows, key), keys)))
    mean, samples = compute(rows)
    want = [numpy_output(decoder, episode, keys[0]) for episode in rows.reshape(EPISODES, STEPS, AGENTS, -1)]
    contributions, log_p = (np.concatenate(values) for values in zip(*want, strict=True))
    np.testing.assert_allclose(samples.r_hat[0], np.sqrt(STEPS * AGENTS) * contributions, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(samples.penalty[0], -0.05 * log_p, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(mean.r_hat, samples.r_hat.mean(axis=0), rtol=1e-4, atol=1e-5)
    assert mean.penalty is None


@pytest.mark.long
def test_must_learn_contributions_and_actions():
    """The reward of an agent is its first entry. It acts by the sign of the mean second entry. Only returns are observed."""
    steps, agents, updates, n_episodes = 3, 2, 100, 32
    observation = np.random.default_rng(0).normal(size=(updates, n_episodes, steps, agents, 2))
    chosen = (observation[..., 1].mean(axis=-1, keepdims=True) > 0).astype(int).repeat(agents, axis=-1)
    rows, reward = np.concatenate([observation, np.eye(2)[chosen]], axis=-1).astype(np.float32), observation[..., 0]
    spec = observation_spec(2, METHODS["tar2"], CreditSettings(learning_rate=1e-3), steps, agents)
    spec = replace(spec, method=METHODS["tar2"], action_size=2)
    batches, flat = whole_batches(rows, reward.mean(axis=(2, 3)), steps), rows[0].reshape(-1, agents, 4)
    state = observed_state(spec, flat, batches.mean_reward[0], batches.length[0], KEY)
    state, _ = fit_batches(state, batches, spec)
    contributions = decoder_rewards(state, flat, spec).reshape(n_episodes, steps, agents)
    assert np.corrcoef(contributions.ravel(), reward[0].ravel())[0, 1] > 0.7
    assert state.network(jnp.asarray(flat), KEY).penalty.mean() < 0.05 * 0.5 * np.log(2)
    shares = np.asarray(shares_of(contributions, np.ones(contributions.shape, bool)))
    assert np.corrcoef(shares.ravel(), reward[0].ravel())[0, 1] > 0.4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"agents": 1}, "among agents"),
        ({"fixed_length": False}, "whole episodes of one length"),
        ({"discrete_actions": False}, "tar2 learns which .* continuous .*: use stas"),
    ],
)
def test_refusals(changes, words):
    assert "exact" not in METHODS["tar2"].settings  # shares add up to the return already
    args = {"agents": AGENTS, "fixed_length": True, "discrete_actions": True} | changes
    is_discrete = args.pop("discrete_actions")
    spec = observation_spec(OBSERVATIONS, METHODS["tar2"], CreditSettings(), STEPS, **args)
    with pytest.raises(LareError, match=words):
        check_credit(spec, spec.agents, discrete_actions=is_discrete)


def numpy_weights(values):
    excess = np.asarray(values, float) - np.min(values)
    return excess / excess.sum() if excess.sum() > 0 else np.full(len(values), 1 / len(values))


def numpy_shares(contributions, alive):
    """Return the shares of one episode, one step after the other."""
    shares = np.zeros(contributions.shape)
    acted = [t for t in range(len(alive)) if alive[t].any()]
    weights = numpy_weights([contributions[t][alive[t]].sum() for t in acted])
    for t, weight in zip(acted, weights, strict=True):
        shares[t, alive[t]] = weight * numpy_weights(contributions[t][alive[t]])
    return shares


def test_shares_against_numpy():
    rng = np.random.default_rng(0)
    contributions = rng.normal(size=(3, STEPS, AGENTS)).astype(np.float32)
    alive = rng.uniform(size=contributions.shape) < 0.6
    alive[0], alive[1, 0], alive[1, 1] = True, False, [True, False, False]
    want = [numpy_shares(*pair) for pair in zip(contributions, alive, strict=True)]
    np.testing.assert_allclose(shares_of(contributions, alive), want, rtol=1e-4, atol=1e-6)


numbers = st.one_of(st.sampled_from((0.0, 1e-20, -1e-38)), st.floats(-1e6, 1e6, width=32))


@settings(deadline=None)
@given(st.lists(numbers, min_size=12, max_size=12), st.lists(st.booleans(), min_size=12, max_size=12))
def test_shares_add_up(contributions, alive):
    """They are never negative, and add up to 1, also if all contributions are equal. Agents that have left have none."""
    contributions, alive = (np.reshape(x, (1, 4, 3)) for x in (np.float32(contributions), alive))
    shares = np.asarray(shares_of(contributions, alive))
    assert (shares >= 0).all()
    assert not shares[~alive].any()
    assert shares.sum() == pytest.approx(float(alive.any()), abs=1e-5)


def test_rewards_add_up_to_the_return():
    """The mean over the agents that are alive, summed over the steps, is the return, whatever the decoder gives."""
    spec = observation_spec(2, METHODS["tar2"], CreditSettings(), STEPS, AGENTS)
    spec = replace(spec, method=METHODS["tar2"], action_size=2)
    rng = np.random.default_rng(0)
    alive = np.ones((2, 2 * STEPS, AGENTS), bool)
    alive[0, 2:STEPS, 1] = alive[1, 1:STEPS, :2] = False
    # Two environments, two episodes each.
    returns = np.repeat(rng.normal(size=(2, 2)), STEPS, axis=1).astype(np.float32)
    inputs = rng.normal(size=(2, 2 * STEPS, AGENTS, 4)).astype(np.float32)
    ended, last = np.ones(returns.shape, bool), np.tile(np.arange(STEPS) == STEPS - 1, (2, 2))
    steps = StepBatch(inputs, np.full(returns.shape, STEPS), returns / STEPS, ended, last, alive)
    unfinished = steps._replace(episode_ended=~steps.episode_ended)  # the return is not known yet

    small = observation_spec(4, METHODS["rd"], CreditSettings(hidden=(4,)), STEPS, AGENTS)
    compute = jax.jit(lambda steps: training_rewards(decoder_state.init(jax.random.key(0), small), steps, spec))
    rewards, contributions = np.asarray(compute(jax.tree.map(lambda *pair: jnp.stack(pair), steps, unfinished)))
    step_rewards = rewards.sum(axis=-1) / np.maximum(alive.sum(axis=-1), 1)
    np.testing.assert_allclose(step_rewards.reshape(4, STEPS).sum(axis=1), returns[:, ::STEPS].ravel(), rtol=1e-4)
    want = numpy_shares(contributions[0, :STEPS], alive[0, :STEPS]) * alive[0, :STEPS].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rewards[0, :STEPS], want * returns[0, 0], rtol=1e-3, atol=1e-5)
