import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.score_type import is_better


@pytest.mark.parametrize(
    ("error", "rival_error", "expected"),
    [
        (np.full(32, 1.0), np.full(32, 2.0), True),
        (np.tile([1.0, 1.2], 16), np.tile([1.1, 1.3], 16), True),
        (np.full(32, 1.0), np.full(32, 1.01), False),  # within the ratio
        (np.full(32, 1.0), np.append(np.full(31, 0.5), 100.0), False),  # a single episode
        (np.append(np.full(31, 0.5), 100.0), np.full(32, 1.0), False),
        (np.zeros(32), np.zeros(32), False),
        (np.full(1, 1.0), np.full(1, 9.0), False),
    ],
)
def test_is_better(error, rival_error, expected):
    returns = np.linspace(-3, 3, len(error))
    inputs = (jnp.asarray(np.append(values, 1e9)) for values in (returns, returns - error, returns + rival_error))
    assert is_better(*inputs, jnp.arange(len(error) + 1) < len(error)) == expected
