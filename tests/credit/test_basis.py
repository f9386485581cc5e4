import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.basis import MAX_FEATURES, MAX_PAIRED_RAW_FEATURES, Basis, expand, fourier_terms
from lare_rl.credit.linear_decoder import init

U = np.array([0.5, -1.0, 2.0, 9.0, -0.3], np.float32)
"""Three factors and two raw features. The first raw feature is far from its mean."""


def numpy_fourier_terms(u):
    clipped = np.clip(u, -4, 4)
    return np.concatenate([wave(k * np.pi * clipped / 4) / k for k in (1, 2, 3) for wave in (np.cos, np.sin)])


def test_expand_by_hand_and_precision():
    basis = Basis(3, 2, extended=True)
    factor_pairs, raw_pairs = [0.5 * -1.0, 0.5 * 2.0, -1.0 * 2.0], [4.0 * -0.3]
    factors = [U[:3], numpy_fourier_terms(U[:3]), factor_pairs]
    want = np.concatenate([*factors, U[3:], numpy_fourier_terms(U[3:]), raw_pairs])
    np.testing.assert_allclose(expand(basis, jnp.asarray(U)), want, rtol=1e-5, atol=1e-6)
    assert list(basis.group_sizes.values()) == [3, 18, 3, 2, 12, 1]
    assert basis.n_features == len(want)
    assert basis.group_index.tolist() == [0] * 3 + [1] * 18 + [2] * 3 + [3] * 2 + [4] * 12 + [5]
    assert basis.is_factor_feature.tolist() == [True] * 24 + [False] * 15
    u = np.linspace(-4, 4, 2001)
    cosine, sine = np.asarray(fourier_terms(jnp.asarray(u[:, None], jnp.float32), 1)).T
    np.testing.assert_allclose(cosine, np.cos(np.pi * u / 4), atol=5e-7)
    np.testing.assert_allclose(sine, np.sin(np.pi * u / 4), atol=5e-7)


def test_groups_may_be_empty():
    for extended in (False, True):
        for n_factors, n_raw in ((0, 4), (4, 0), (1, 1), (0, 0)):
            basis = Basis(n_factors, n_raw, extended)
            assert expand(basis, jnp.ones((7, basis.n_inputs))).shape == (7, basis.n_features)
            assert all(basis.group_sizes.values())
            assert extended or basis.n_features == basis.n_inputs
    images = Basis(2, 5000, extended=True)  # their entries are not used
    assert images.n_inputs == 5002
    assert expand(images, jnp.zeros((3, 5002))).shape == (3, images.n_features) == (3, 15)
    assert Basis(0, 5000, extended=False).n_features == 0


@pytest.mark.parametrize(("n_raw", "frequencies"), [(12, 3), (73, 3), (74, 2), (100, 2), (200, 0), (393, 0), (900, 0)])
def test_many_raw_features_have_fewer_frequencies_and_no_pairs(n_raw, frequencies):
    basis = Basis(0, n_raw, extended=True)
    n_pairs = n_raw * (n_raw - 1) // 2 if n_raw <= MAX_PAIRED_RAW_FEATURES else 0
    assert basis.raw_frequencies == frequencies
    assert basis.n_features == n_raw * (1 + 2 * frequencies) + n_pairs
    assert basis.n_features <= max(MAX_FEATURES, n_raw)
    assert Basis(20, 50, extended=True).raw_frequencies == 1  # factors leave less room


@pytest.mark.parametrize("sizes", [(3, 2, 0), (3, 13, 3), (0, 4, 4), (2, 0, 2)])
def test_reads_names_the_features_that_an_input_changes(sizes):
    basis = Basis(sizes[0], sizes[1], extended=True, n_tracked=sizes[2])
    rng, size, features = np.random.default_rng(0), basis.n_standardised, init(basis, 1).features
    rows = rng.normal(size=(100, basis.n_inputs)).astype(np.float32)
    for i in range(size):
        changed = [i, *(size + i + basis.n_tracked * np.arange(3))] if i < basis.n_tracked else [i]
        other_rows = rows.copy()
        other_rows[:, changed] = rng.normal(size=(100, len(changed)))
        differs = np.any(features(jnp.asarray(other_rows)) != features(jnp.asarray(rows)), axis=0)
        np.testing.assert_array_equal(differs, basis.reads(jnp.arange(size) == i))
