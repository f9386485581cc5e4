import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.prequential import Predictions
from lare_rl.credit.score_type import ScoreType, ScoreTypeEstimate, compare_score_types, is_better


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
def test_is_better_and_certain(error, rival_error, expected):
    """A type that is used is certain if it would have been chosen."""
    n, returns = len(error), np.linspace(-3, 3, len(error))
    returns, *predicted = (np.append(values, 1e9) for values in (returns, returns - error, returns + rival_error))
    predictions = Predictions(jnp.array(n), jnp.asarray(returns), jnp.stack(predicted, axis=1), jnp.zeros(n + 1, int))
    assert is_better(predictions, 0, 1) == expected
    estimate = compare_score_types(predictions, (ScoreType.SUM, ScoreType.AVERAGE), 0)
    assert estimate == ScoreTypeEstimate(ScoreType.SUM, is_certain=expected, rival=ScoreType.AVERAGE)
