import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.nn import normalise

update_mean_std, update_scale = jax.jit(normalise.update_mean_std), jax.jit(normalise.update_scale)
standardise = jax.jit(normalise.standardise)


def observe(batch):
    return update_mean_std(normalise.empty_mean_std(batch.shape[1]), jnp.asarray(batch))


@given(
    masks=st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1, max_size=5),
    seed=st.integers(0, 1000),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
)
@settings(max_examples=40, deadline=None)
def test_statistics_are_those_of_all_valid_rows(masks, seed, scale):
    rng, statistics, valid_rows = np.random.default_rng(seed), normalise.empty_mean_std(2), []
    for mask in np.array(masks):
        rows = (scale * (3 + rng.normal(size=(5, 2)))).astype(np.float32)
        batch = jnp.asarray(np.where(mask[:, None], rows, 1e6 * scale))
        statistics = update_mean_std(statistics, batch, None if mask.all() else jnp.asarray(mask))
        valid_rows.append(rows[mask])
    rows = np.concatenate(valid_rows)
    assert float(statistics.n_rows) == len(rows)
    mean = rows.mean(axis=0) if len(rows) else np.zeros(2)
    np.testing.assert_allclose(statistics.mean, mean, rtol=1e-4)
    squares = ((rows - mean) ** 2).sum(axis=0)
    np.testing.assert_allclose(statistics.sum_squares, squares, rtol=1e-2, atol=1e-5 * scale**2)


def test_standardise():
    rows = np.random.default_rng(0).normal(5, 3, (1000, 1)).astype(np.float32)
    scaled = np.asarray(standardise(observe(rows), jnp.asarray(rows)))
    assert scaled.mean() == pytest.approx(0, abs=1e-4)
    assert scaled.std() == pytest.approx(1, rel=1e-4)
    assert float(standardise(observe(rows), jnp.array([[1e9]]))[0, 0]) == normalise.CLIP
    for factor in (1e-3, 1e3):
        other = standardise(observe(rows * factor), jnp.asarray(rows * factor))
        np.testing.assert_allclose(scaled, other, atol=1e-3)
    for constant in (0.0, 1e9, -1e-9):
        rows = jnp.full((50, 1), constant)
        assert not standardise(update_mean_std(observe(rows), rows), rows).any()
    rows, statistics = jnp.array([[3.0, -70.0]]), observe(np.array([[1.0, 2.0], [3.0, 6.0]], np.float32))
    np.testing.assert_array_equal(normalise.standardise_unless_empty(normalise.empty_mean_std(2), rows), rows)
    want = standardise(statistics, rows)
    np.testing.assert_array_equal(normalise.standardise_unless_empty(statistics, rows), want)


def test_scale():
    scale = normalise.empty_scale()
    assert float(normalise.root_mean_square(scale)) == 1.0
    scale = update_scale(scale, jnp.zeros(4), jnp.zeros(4, bool))
    assert float(normalise.root_mean_square(scale)) == 1.0
    scale = update_scale(scale, jnp.array([3.0, 100.0]), jnp.array([True, False]))
    scale = update_scale(scale, jnp.array([4.0, 5.0]), jnp.array([True, True]))
    assert float(normalise.root_mean_square(scale)) == pytest.approx(np.sqrt((9 + 16 + 25) / 3))
    scale = update_scale(normalise.empty_scale(), jnp.array([3.0]), jnp.array([False]))
    assert (float(scale.lowest), float(scale.highest)) == (0, 0)
    scale = update_scale(scale, jnp.array([3.0, 9.0, -5.0]), jnp.array([True, False, False]))
    np.testing.assert_array_equal(normalise.min_max_scale(scale, jnp.array([3.0, 4.0])), [0.5, 0.5])
    scale = update_scale(scale, jnp.array([1.0, 5.0, 99.0]), jnp.array([True, True, False]))
    np.testing.assert_array_equal(normalise.min_max_scale(scale, jnp.array([1.0, 2.0, 5.0])), [0, 0.25, 1])
