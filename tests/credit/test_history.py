import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lare_rl.credit import history as histories
from lare_rl.credit.basis import Basis, expand_history, fourier_terms
from lare_rl.credit.history import next_history

scan_history = jax.jit(histories.scan_history)
VALUES = arrays(np.float32, (7, 2), elements=st.floats(-3, 3, width=32, allow_subnormal=False))
BEGINS = st.lists(st.booleans(), min_size=7, max_size=7)


def slow_history(entries, begins):
    """Return the history of each step by a loop over the steps before it."""
    rows = np.full((len(entries), 3, entries.shape[1]), np.nan)
    start = 0
    for t, first in enumerate(begins):
        start = t if first else start
        if t > start:
            before = entries[start:t]
            rows[t] = before.max(axis=0), before.min(axis=0), before[-1]
    return rows


@given(VALUES, BEGINS)
@settings(max_examples=50, deadline=None)
def test_scan_history_matches_slow_twin(entries, begins):
    begins[0] = True
    before = jnp.full((3, 2), 9.0)  # of another episode
    history = scan_history(before, jnp.asarray(entries), jnp.asarray(begins))
    np.testing.assert_array_equal(history, slow_history(entries, begins))


def test_scan_history_continues():
    entries = np.random.default_rng(0).normal(size=(9, 2)).astype(np.float32)
    begins = np.arange(9) == 0
    at_once = scan_history(jnp.full((3, 2), jnp.nan), jnp.asarray(entries), jnp.asarray(begins))
    last = next_history(np.asarray(at_once)[3], entries[3])
    rest = scan_history(jnp.asarray(last), jnp.asarray(entries[4:]), jnp.zeros(5, bool))
    np.testing.assert_array_equal(rest, at_once[4:])


@pytest.mark.parametrize("n_raw", [0, 40])
def test_history_features_add_up_to_functions_of_extremes(n_raw):
    n_tracked = n_raw or 3
    basis = Basis(0 if n_raw else 3, n_raw, extended=True, n_tracked=n_tracked)
    u = jnp.asarray(np.random.default_rng(1).normal(size=(6, n_tracked)), jnp.float32)
    history = scan_history(jnp.zeros((3, n_tracked)), u, jnp.arange(6) == 0)
    total = expand_history(basis, u, history).sum(axis=0)
    expected = [
        function(values)
        for values in (u.max(axis=0), u.min(axis=0), u[-1])
        for function in (lambda v: v, lambda v: fourier_terms(v, basis.history_frequencies))
    ]
    np.testing.assert_allclose(total, jnp.concatenate(expected), rtol=1e-4, atol=1e-5)
    names = [name for name in basis.group_sizes if "tracked" in name]
    assert sum(basis.group_sizes[name] for name in names) == len(total)
    assert basis.n_features == len(total) + Basis(basis.n_factors, n_raw, extended=True).n_features
    assert basis.n_inputs == basis.n_standardised + 3 * n_tracked
