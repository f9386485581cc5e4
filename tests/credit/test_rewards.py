import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from lare_rl.credit import decoder_state, rewards
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS
from lare_rl.credit.rewards import StepBatch


@pytest.mark.parametrize(("exact", "expected"), [("last", [0, 0, 0, 2]), ("spread", [0.5] * 4)])
def test_residual_is_added_once(exact, expected):
    """The proxy rewards of a linear decoder are 0 before the first fit."""
    spec = observation_spec(2, METHODS["rd-linear"], CreditSettings(exact=exact), max_steps=4)
    length, is_true = np.full(4, 4), np.ones(4, bool)
    arrays = np.ones((4, 1, 2), np.float32), length, np.zeros(4), is_true, np.arange(4) == 3, is_true[:, None]
    steps = jax.tree.map(jnp.asarray, StepBatch(*arrays, residual=np.full(4, 2.0)))
    state = decoder_state.init(jax.random.key(0), spec)
    reward = jax.jit(rewards.training_rewards, static_argnames="spec")(state, steps, spec=spec)
    assert reward[:, 0].tolist() == expected


def test_designed_reward_is_the_first_input():
    spec = observation_spec(2, METHODS["llm-reward"], CreditSettings(), max_steps=3)
    inputs, is_true = jnp.arange(6.0).reshape(3, 1, 2), jnp.ones(3, bool)
    steps = StepBatch(inputs, jnp.full(3, 3), jnp.zeros(3), is_true, is_true, is_true[:, None])
    state = decoder_state.init(jax.random.key(0), spec)
    state = decoder_state.observe_steps(state, inputs)
    state = decoder_state.observe_returns(state, jnp.full(3, 9.0), steps.length, is_true, None)
    assert rewards.training_rewards(state, steps, spec)[:, 0].tolist() == [0, 2, 4]
