import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.nn.dropout import dropout


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_dropout(rate):
    output = np.asarray(dropout(jnp.ones((200, 20, 13)), jax.random.key(1), rate))
    np.testing.assert_allclose(np.unique(output), [0, 1 / (1 - rate)], rtol=1e-6)
    assert np.abs(output.mean(axis=0) - 1).max() < 0.5  # over 200: 7 standard deviations
    assert np.abs(np.corrcoef(output.reshape(-1, 13).T) - np.eye(13)).max() < 0.1
    np.testing.assert_array_equal(dropout(jnp.ones(3), None, rate), 1)
