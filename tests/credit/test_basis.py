"""Features in groups, against what their equations say of a single row."""

import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit.basis import LARGEST, MOST_PAIRED, Basis, cosine_and_sine, expand, shapes

U = np.array([0.5, -1.0, 2.0, 9.0, -0.3], np.float32)
"""Three factors and two entries, one of which is far out."""


def series(u):
    """cos and sin of k pi u / 4, over k, for each number of u."""
    within = np.clip(u, -4, 4)
    return np.concatenate([wave(k * np.pi * within / 4) / k for k in (1, 2, 3) for wave in (np.cos, np.sin)])


def test_all_groups_by_hand():
    basis = Basis(3, 2, extended=True)
    pairs, of_entries = [0.5 * -1.0, 0.5 * 2.0, -1.0 * 2.0], [4.0 * -0.3]
    want = np.concatenate([U[:3], series(U[:3]), pairs, U[3:], series(U[3:]), of_entries])
    np.testing.assert_allclose(expand(basis, jnp.asarray(U)), want, rtol=1e-5, atol=1e-6)
    assert list(basis.sizes.values()) == [3, 18, 3, 2, 12, 1]
    assert basis.size == len(want) == len(basis.group)
    assert basis.group.tolist() == [0] * 3 + [1] * 18 + [2] * 3 + [3] * 2 + [4] * 12 + [5]


@pytest.mark.parametrize("factors", [2, 0])
def test_pairs_are_of_inputs_within_four_deviations(factors):
    got = expand(Basis(factors, 2 - factors, extended=True), jnp.array([3.0, 9.0]))
    assert float(got[-1]) == 12


def test_many_entries_get_no_pairs():
    assert Basis(0, MOST_PAIRED, extended=True).sizes["pairs of entries"] == MOST_PAIRED * (MOST_PAIRED - 1) / 2
    assert "pairs of entries" not in Basis(0, MOST_PAIRED + 1, extended=True).sizes
    assert "pairs of entries" not in Basis(0, MOST_PAIRED, extended=False).sizes


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize(("factors", "entries"), [(0, 4), (4, 0), (1, 1), (0, 0)])
def test_groups_that_are_not_there(factors, entries, extended):
    basis = Basis(factors, entries, extended)
    rows = jnp.ones((7, factors + entries))
    assert expand(basis, rows).shape == (7, basis.size)
    assert all(basis.sizes.values())
    if not extended:
        assert basis.size == basis.inputs


@pytest.mark.parametrize(
    ("entries", "frequencies"), [(23, 3), (73, 3), (74, 2), (100, 2), (200, 0), (393, 0), (900, 0)]
)
def test_many_entries_get_fewer_shapes(entries, frequencies):
    basis = Basis(0, entries, extended=True)
    assert basis.frequencies_of_entries == frequencies
    assert basis.size == entries * (1 + 2 * frequencies)
    assert basis.size <= max(LARGEST, entries)


def test_no_frequencies_are_no_features():
    assert shapes(jnp.ones((3, 2)), 0).shape == (3, 0)


def test_entries_of_a_picture_are_left_out():
    basis = Basis(2, 5000, extended=True)
    assert "entries" not in basis.sizes
    assert basis.inputs == 5002
    assert expand(basis, jnp.zeros((3, 5002))).shape == (3, basis.size) == (3, 15)
    assert Basis(0, 5000, extended=False).size == 0


def test_waves_to_the_precision_of_float32():
    angle = np.linspace(-np.pi, np.pi, 2001)
    cosine, sine = cosine_and_sine(jnp.asarray(angle, jnp.float32))
    np.testing.assert_allclose(cosine, np.cos(angle), atol=3e-7)
    np.testing.assert_allclose(sine, np.sin(angle), atol=3e-7)
