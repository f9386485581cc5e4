import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.nn import normalise


def observe_all(batches):
    statistics = normalise.new_mean_std(batches[0].shape[1])
    for batch in batches:
        statistics = normalise.observe(statistics, jnp.asarray(batch))
    return statistics


@given(st.lists(st.integers(1, 7), min_size=1, max_size=5), st.integers(0, 1000), st.sampled_from([1e-6, 1.0, 1e6]))
@settings(max_examples=30, deadline=None)
def test_statistics_are_those_of_every_row(sizes, seed, scale):
    rng = np.random.default_rng(seed)
    batches = [(scale * (3 + rng.normal(size=(size, 2)))).astype(np.float32) for size in sizes]
    statistics, rows = observe_all(batches), np.concatenate(batches)
    np.testing.assert_allclose(statistics.mean, rows.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(statistics.squares, ((rows - rows.mean(axis=0)) ** 2).sum(axis=0), rtol=1e-2, atol=1e-10)


@given(st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1, max_size=5), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_rows_that_are_masked_are_as_if_they_had_never_been(masks, seed):
    rng, statistics, kept = np.random.default_rng(seed), normalise.new_mean_std(2), []
    for mask in np.array(masks):
        rows = (3 + rng.normal(size=(5, 2))).astype(np.float32)
        statistics = normalise.observe(statistics, jnp.asarray(np.where(mask[:, None], rows, 1e6)), jnp.asarray(mask))
        kept.append(rows[mask])
    kept = np.concatenate(kept)
    assert float(statistics.rows) == len(kept)
    mean = kept.mean(axis=0) if len(kept) else np.zeros(2)
    np.testing.assert_allclose(statistics.mean, mean, rtol=1e-4)
    np.testing.assert_allclose(statistics.squares, ((kept - mean) ** 2).sum(axis=0), rtol=1e-2, atol=1e-5)


def test_rows_are_as_they_are_until_something_is_known():
    rows = jnp.array([[3.0, -70.0]])
    np.testing.assert_array_equal(normalise.standardise_if_known(normalise.new_mean_std(2), rows), rows)
    some = observe_all([np.array([[1.0, 2.0], [3.0, 6.0]], np.float32)])
    np.testing.assert_array_equal(normalise.standardise_if_known(some, rows), normalise.standardise(some, rows))


def test_standardised_rows_have_unit_spread_and_are_cut_off():
    rows = np.random.default_rng(0).normal(5, 3, (1000, 1)).astype(np.float32)
    statistics = observe_all([rows])
    scaled = np.asarray(normalise.standardise(statistics, jnp.asarray(rows)))
    assert scaled.mean() == pytest.approx(0, abs=1e-4)
    assert scaled.std() == pytest.approx(1, rel=1e-4)
    assert float(normalise.standardise(statistics, jnp.array([[1e9]]))[0, 0]) == normalise.CLIP


@pytest.mark.parametrize("constant", [0.0, 7.0, 1e9, -1e-9])
def test_a_feature_that_never_varies_becomes_zero(constant):
    # Reacher's entry 10 is always 0.
    rows = jnp.full((50, 1), constant)
    assert float(jnp.abs(normalise.standardise(observe_all([rows, rows]), rows)).max()) == 0.0


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_scaled_features_standardise_alike(factor):
    rows = np.random.default_rng(1).normal(2, 1, (100, 3)).astype(np.float32)
    plain = normalise.standardise(observe_all([rows]), jnp.asarray(rows))
    scaled = normalise.standardise(observe_all([rows * factor]), jnp.asarray(rows * factor))
    np.testing.assert_allclose(plain, scaled, atol=1e-3)


def test_scale_is_the_root_mean_square_of_what_counts():
    scale = normalise.new_scale()
    assert float(normalise.magnitude(scale)) == 1.0
    scale = normalise.observe_scale(scale, jnp.array([3.0, 100.0]), jnp.array([True, False]))
    scale = normalise.observe_scale(scale, jnp.array([4.0, 5.0]), jnp.array([True, True]))
    assert float(normalise.magnitude(scale)) == pytest.approx(np.sqrt((9 + 16 + 25) / 3))


def test_scale_is_one_as_long_as_every_return_was_zero():
    scale = normalise.observe_scale(normalise.new_scale(), jnp.zeros(4), jnp.ones(4, bool))
    assert float(normalise.magnitude(scale)) == 1.0


def test_the_range_of_what_counted():
    scale = normalise.observe_scale(normalise.new_scale(), jnp.array([3.0, 9.0, -5.0]), jnp.array([True, False, False]))
    assert (float(scale.lowest), float(scale.highest)) == (3, 3)
    np.testing.assert_array_equal(normalise.within_range(scale, jnp.array([3.0, 4.0])), [0.5, 0.5])
    scale = normalise.observe_scale(scale, jnp.array([1.0, 5.0, 99.0]), jnp.array([True, True, False]))
    np.testing.assert_array_equal(normalise.within_range(scale, jnp.array([1.0, 2.0, 5.0])), [0, 0.25, 1])
    untouched = normalise.observe_scale(normalise.new_scale(), jnp.array([3.0]), jnp.array([False]))
    assert (float(untouched.lowest), float(untouched.highest)) == (0, 0)
