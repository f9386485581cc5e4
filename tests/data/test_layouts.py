import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.data.layouts import lay_out_packed, lay_out_padded, lay_out_sampled, sample_step_numbers

pack = jax.jit(lay_out_packed, static_argnums=2)
sample_numbers = jax.jit(sample_step_numbers, static_argnums=2)


@given(st.lists(st.integers(1, 9), min_size=6, max_size=6), st.integers(0, 5), st.sampled_from([9, 24, 60]))
@settings(max_examples=60, deadline=None)
def test_lay_out_packed(lengths, n_masked, rows):
    length, mask = np.array(lengths), (np.arange(6) < 6 - n_masked).astype(float)
    layout, fits = lay_out_packed(length, mask, rows)
    steps, n_rows = [], 0
    for slot, count in enumerate(lengths):
        n_rows += count
        assert fits[slot] == (mask[slot] and n_rows <= rows)
        steps += [(slot, t) for t in range(count)] if fits[slot] else []
    padding = [(6, 0)] * (rows - len(steps))
    assert list(zip(layout.episode_index.tolist(), layout.step.tolist(), strict=True)) == steps + padding
    jax.tree.map(np.testing.assert_array_equal, pack(length, mask, rows), (layout, fits))


def test_lay_out_packed_does_not_count_episodes_of_no_batch():
    """Their lengths may add up to more than 32 bits."""
    mask = (jnp.arange(65_536) == 0).astype(float)
    layout, fits = pack(jnp.full(65_536, 65_536), mask, 65_536)
    assert fits.sum() == 1
    assert layout.episode_index.tolist() == [0] * 65_536


@pytest.mark.parametrize("xp", [np, jnp])
def test_lay_out_padded_and_sampled(xp):
    layout = lay_out_padded(xp.array([[3, 1], [2, 4]]), 4)
    assert layout.step.tolist() == [[[0, 1, 2, 2], [0] * 4], [[0, 1, 1, 1], [0, 1, 2, 3]]]
    assert layout.episode_index.tolist() == [[[0] * 4, [1] * 4]] * 2
    layout = lay_out_sampled(xp.array([2, 5]), xp.array([[0, 1, 1], [4, 2, 0]]))
    assert layout.episode_index.tolist() == [[0, 0, 2], [1, 1, 1]]
    assert layout.step.tolist() == [[0, 1, 1], [4, 2, 0]]


@given(st.lists(st.integers(1, 40), min_size=6, max_size=6), st.sampled_from([1, 2, 12]), st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_sample_steps_has_no_repeats(lengths, steps, seed):
    numbers = np.asarray(sample_numbers(jax.random.key(seed), jnp.asarray(lengths), steps))
    assert numbers.shape == (len(lengths), steps)
    for length, row in zip(lengths, numbers, strict=True):
        assert row.min() >= 0
        assert row.max() < length
        assert len(set(row)) == min(length, steps)
        if length < steps:
            np.testing.assert_array_equal(row, np.minimum(np.arange(steps), length - 1))


def test_sample_steps_is_uniform_over_pairs():
    numbers = np.sort(np.asarray(sample_numbers(jax.random.key(2), jnp.full(30_000, 5), 2)), axis=1)
    share = np.bincount(numbers[:, 0] * 5 + numbers[:, 1], minlength=25) / len(numbers)
    np.testing.assert_allclose(share[share > 0], 0.1, atol=0.01)
    assert (share > 0).sum() == 10
