import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.nn.masks import masked_mean, select


def test_masked_mean_and_select():
    x = jnp.array([1.0, 2.0, 6.0])
    assert masked_mean(x, jnp.array([True, False, True])) == pytest.approx(3.5)
    assert masked_mean(x, jnp.zeros(3)) == 0
    assert masked_mean(x, None) == pytest.approx(3)
    # Rows come from either tree. A buffer that rows share stays.
    new, old = ({"rows": jnp.full((2, 3), value), "shared": jnp.full(4, value)} for value in (1.0, 0.0))
    selected = select(jnp.array([True, False]), new, old)
    np.testing.assert_array_equal(selected["rows"], [[1] * 3, [0] * 3])
    np.testing.assert_array_equal(selected["shared"], [0] * 4)
