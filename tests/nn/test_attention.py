import jax.numpy as jnp
import numpy as np
import pytest

from helpers.numpy_attention import numpy_attention, numpy_layer_norm
from lare_rl.nn.attention import LayerNorm, attend, causal_mask


@pytest.mark.parametrize(("batch", "queries"), [((), 4), ((3, 2), 7)])
def test_attend_against_numpy(batch, queries):
    rng = np.random.default_rng(0)
    query, key, value = (rng.normal(size=(*batch, tokens, 2, 3)).astype(np.float32) for tokens in (queries, 4, 4))
    mask = np.asarray(causal_mask(4)) if queries == 4 else (rng.random((queries, 4)) < 0.5) | (np.arange(4) == 0)
    output = attend(jnp.asarray(query), jnp.asarray(key), jnp.asarray(value), jnp.asarray(mask))
    for i in np.ndindex(batch):
        np.testing.assert_allclose(output[i], numpy_attention(query[i], key[i], value[i], mask), 1e-4, 1e-5)


def test_attend_with_several_masks():
    rng = np.random.default_rng(1)
    query, key, value = (jnp.asarray(rng.normal(size=(5, 4, 2, 3)), jnp.float32) for _ in range(3))
    masks = jnp.asarray((rng.random((3, 4, 4)) < 0.5) | np.eye(4, dtype=bool))
    outputs = [attend(query, key, value, mask) for mask in masks]
    np.testing.assert_allclose(attend(query, key, value, masks), jnp.concatenate(outputs, axis=1), 1e-5, 1e-6)
    mean = attend(query, key, value, masks, lambda weights: jnp.mean(weights, axis=1))
    np.testing.assert_allclose(mean, jnp.mean(jnp.stack(outputs), axis=0), 1e-5, 1e-6)


def test_layer_norm_against_numpy():
    rows = np.random.default_rng(0).normal(3, 2, (5, 8)).astype(np.float32)
    np.testing.assert_allclose(LayerNorm(8)(jnp.asarray(rows)), numpy_layer_norm(rows, 1e-5), rtol=1e-4, atol=1e-5)
