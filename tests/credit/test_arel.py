import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.credit_specs import observation_spec
from helpers.decoder_toys import decoder_rewards, make_decoder, observed_state
from helpers.numpy_attention import numpy_attention, numpy_layer_norm, numpy_linear
from lare_rl.credit import descent
from lare_rl.credit.arel import Block
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.decoder_state import CreditBatch
from lare_rl.credit.methods import METHODS
from lare_rl.nn.attention import causal_mask

EPISODES, STEPS, AGENTS, FEATURES = 4, 5, 3, 6
KEY = jax.random.key(1)
ROWS = np.random.default_rng(0).normal(size=(EPISODES * STEPS, AGENTS, FEATURES)).astype(np.float32)


def test_block_against_numpy():
    block, x = Block(FEATURES, key=KEY), ROWS[:STEPS, 0]
    projected = np.split(x @ np.asarray(block.projections), 3, axis=1)
    attention = numpy_attention(
        *(values.reshape(STEPS, 3, FEATURES) for values in projected), np.tri(STEPS, dtype=bool)
    )
    y = numpy_layer_norm(x + numpy_linear(block.merge, attention), 1e-5)
    first, second = block.feed_forward.layers
    want = numpy_layer_norm(y + numpy_linear(second, np.maximum(numpy_linear(first, y), 0)), 1e-5)
    np.testing.assert_allclose(block(jnp.asarray(x), causal_mask(STEPS)), want, rtol=1e-3, atol=1e-4)


def test_a_single_step_has_no_variance():
    decoder = make_decoder("arel", FEATURES, 1, AGENTS)
    assert not jax.jit(lambda rows: decoder(rows, KEY).penalty)(ROWS).any()


@pytest.mark.long
def test_loss_is_the_published_one_in_other_units():
    """(R - sum_t y_t)^2 + 20 Var_t(y), as published, divided by T^2 and by the square of the scale."""
    spec = observation_spec(FEATURES, METHODS["arel"], CreditSettings(), STEPS, AGENTS)
    mean_reward, length = np.float32([3.0, -1.0, 2.0, 0.5]), np.full(EPISODES, STEPS)
    state = observed_state(spec, ROWS, mean_reward, length, KEY)
    batch = CreditBatch(ROWS, np.repeat(np.arange(EPISODES), STEPS), length, mean_reward, mask=np.ones(EPISODES))
    loss, _ = jax.jit(descent.loss_and_gradient, static_argnames="spec")(state, batch, KEY, spec)
    y = np.asarray(decoder_rewards(state, ROWS, spec)).reshape(EPISODES, STEPS, AGENTS)[..., 0]
    published = ((STEPS * mean_reward - y.sum(axis=1)) ** 2).mean() + 20 * y.var(axis=1, ddof=1).mean()
    assert float(loss) * np.mean(mean_reward**2) * STEPS**2 == pytest.approx(float(published), rel=1e-4)
