import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.credit_specs import observation_spec
from lare_rl.credit import decomposition, engine
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.engine import StepBatch, return_shares
from lare_rl.credit.methods import METHODS
from lare_rl.credit.spec import CreditSpec

EPISODES, STEPS, AGENTS = 3, 4, 3
shares_of = jax.jit(return_shares)


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
    contributions = rng.normal(size=(EPISODES, STEPS, AGENTS)).astype(np.float32)
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
    spec = CreditSpec(
        method=METHODS["tar2"],
        settings=CreditSettings(),
        observation_size=2,
        action_size=2,
        single_agent=False,
        agents=AGENTS,
        max_steps=STEPS,
        fixed_length=True,
    )
    rng = np.random.default_rng(0)
    alive = np.ones((2, 2 * STEPS, AGENTS), bool)
    alive[0, 2:STEPS, 1] = alive[1, 1:STEPS, :2] = False
    # Two environments, two episodes each.
    returns = np.repeat(rng.normal(size=(2, 2)), STEPS, axis=1).astype(np.float32)
    inputs = rng.normal(size=(2, 2 * STEPS, AGENTS, 4)).astype(np.float32)
    ended, last = np.ones(returns.shape, bool), np.tile(np.arange(STEPS) == STEPS - 1, (2, 2))
    steps = StepBatch(inputs, np.full(returns.shape, STEPS), returns / STEPS, ended, last, alive)
    unfinished = steps._replace(episode_ended=~steps.episode_ended)  # the return is not known yet

    @jax.jit
    def compute(steps):
        decoder = decomposition.init(
            jax.random.key(0), observation_spec(4, METHODS["rd"], CreditSettings(hidden=(4,)), STEPS, AGENTS)
        )
        return engine.training_rewards(decoder, steps, spec)

    rewards, contributions = np.asarray(compute(jax.tree.map(lambda *pair: jnp.stack(pair), steps, unfinished)))
    step_rewards = rewards.sum(axis=-1) / np.maximum(alive.sum(axis=-1), 1)
    np.testing.assert_allclose(step_rewards.reshape(4, STEPS).sum(axis=1), returns[:, ::STEPS].ravel(), rtol=1e-4)
    want = numpy_shares(contributions[0, :STEPS], alive[0, :STEPS]) * alive[0, :STEPS].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rewards[0, :STEPS], want * returns[0, 0], rtol=1e-3, atol=1e-5)


def test_correction_adds_the_residual_once():
    residual, length, last = np.full(4, 2.0), np.full(4, 4), np.arange(4) == 3
    assert np.asarray(engine.correction(residual, last, length, "last")).tolist() == [0, 0, 0, 2]
    assert np.asarray(engine.correction(residual, last, length, "spread")).tolist() == [0.5] * 4
