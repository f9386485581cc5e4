"""The equations against pinned numbers and a slow NumPy twin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import losses


@pytest.fixture(params=[lambda f: f, jax.jit], ids=["plain", "jit"])
def variant(request):
    return request.param


def test_episode_means_count_only_what_belongs(variant):
    r_hat = jnp.array([1.0, 2.0, 3.0, 10.0, 20.0, 99.0])
    episode = jnp.array([0, 0, 0, 1, 1, 2])  # the last row belongs to no episode
    means = variant(losses.episode_means)(r_hat, episode, jnp.array([3, 2]))
    np.testing.assert_allclose(means, [2.0, 15.0])


def test_squared_error_pinned(variant):
    loss = variant(losses.squared_error)(jnp.array([1.0, 4.0]), jnp.array([0.0, 2.0]), jnp.ones(2))
    assert float(loss) == pytest.approx((1 + 4) / 2)


def test_squared_error_passes_over_empty_places(variant):
    full = variant(losses.squared_error)(jnp.array([1.0]), jnp.array([0.0]), jnp.ones(1))
    padded = variant(losses.squared_error)(jnp.array([1.0, 7.0]), jnp.array([0.0, 2.0]), jnp.array([1.0, 0.0]))
    assert float(full) == float(padded) == 1.0
    assert float(losses.squared_error(jnp.ones(2), jnp.zeros(2), jnp.zeros(2))) == 0.0


def test_sum_form_is_the_squared_error_of_sums():
    r_hat, returns, length = jnp.array([0.5, -1.0]), jnp.array([4.0, 3.0]), jnp.array([4, 2])
    weight = losses.episode_weight(length, jnp.ones(2), sum_form=True)
    loss = losses.squared_error(r_hat, returns / length, weight)
    assert float(loss) == pytest.approx(((0.5 * 4 - 4) ** 2 + (-1.0 * 2 - 3) ** 2) / 2)
    np.testing.assert_array_equal(losses.episode_weight(length, jnp.array([1.0, 0.0]), sum_form=False), [1, 0])


def test_subsampling_variance_pinned(variant):
    # K = 4 of T = 8: sample variance of 1, 2, 3, 4 is 5/3, times (1 - 1/2) / 4.
    variance = variant(losses.subsampling_variance)(jnp.array([[1.0, 2.0, 3.0, 4.0]]), jnp.array([8]))
    np.testing.assert_allclose(variance, [5 / 3 * 0.5 / 4], rtol=1e-6)


@pytest.mark.parametrize("length", [1, 3, 4], ids=lambda length: f"T={length}")
def test_subsampling_variance_is_zero_where_k_reaches_t(length):
    # Reacher: T = 50 < K = 64. The published coefficient turns negative there.
    assert float(losses.subsampling_variance(jnp.array([[1.0, 2.0, 3.0, 4.0]]), jnp.array([length]))[0]) == 0.0


def test_unbiased_loss_has_the_expectation_of_the_full_one():
    """E[RRD-unbiased] over the drawing = RD's loss; E[RRD] is larger by the variance."""
    rng = np.random.default_rng(0)
    length, drawn, draws = 12, 5, 40_000
    r_hat, mean_reward = rng.normal(size=length), 0.3
    rows = np.stack([rng.choice(r_hat, drawn, replace=False) for _ in range(draws)]).astype(np.float32)
    target, lengths, weight = jnp.full(draws, mean_reward), jnp.full(draws, length), jnp.ones(draws)
    full = (r_hat.mean() - mean_reward) ** 2
    biased = float(losses.squared_error(jnp.asarray(rows.mean(axis=1)), target, weight))
    variance = losses.subsampling_variance(jnp.asarray(rows), lengths)
    unbiased = float(losses.unbiased_squared_error(jnp.asarray(rows.mean(axis=1)), target, weight, variance))
    extra = r_hat.var(ddof=1) * (1 - drawn / length) / drawn
    assert unbiased == pytest.approx(full, abs=0.01)
    assert biased == pytest.approx(full + extra, abs=0.01)
    assert extra > 0.05
