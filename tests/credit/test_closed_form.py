import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.basis import Basis
from lare_rl.credit.linear_decoder import select_score_type
from lare_rl.credit.score_type import ScoreType
from lare_rl.nn.normalise import empty_mean_std, update_mean_std

PLAIN = Basis(3, 0, extended=False)
init = jax.jit(closed_form.init, static_argnums=(0, 1))
fit = jax.jit(closed_form.fit, static_argnames=("score_types", "max_rounds"))


def sample_episodes(count=20, seed=0, noise=0.0):
    """Return factors of steps, lengths, and returns of the signed sum with signs (1, -1, -1)."""
    length = np.random.default_rng(count).integers(3, 9, size=count)
    random = np.random.default_rng(seed)
    rows = [random.normal(size=(T, 3)) + random.normal(size=3) + 5 for T in length]
    returns = [(episode @ [1.0, -1.0, -1.0]).sum() + noise * random.normal() for episode in rows]
    return rows, length, np.array(returns)


@jax.jit
def add_episodes(state, rows, length, returns):
    """Add episodes, whose steps are rows one after the other."""
    features = state.decoder.features(rows)
    number = jnp.repeat(jnp.arange(len(length)), length, total_repeat_length=len(rows))
    means = jax.ops.segment_sum(features, number, len(length)) / length[:, None]
    statistics = evidence.to_float64(state.sufficient_statistics)
    statistics = evidence.add_episodes(statistics, means, returns, length)
    return state._replace(sufficient_statistics=evidence.split_double(statistics))


def observed(rows):
    return update_mean_std(empty_mean_std(rows.shape[1]), jnp.asarray(rows, jnp.float32))


def fit_signs_in_float64(state):
    with jax.enable_x64(True):
        return closed_form.fit_signs(state)


@pytest.mark.parametrize("seed", range(4))
def test_fit_signs_against_trying_all(seed):
    rows, length, returns = sample_episodes(seed=seed, noise=30.0)
    returns += 8 * length  # no signs give this level: the fit must weigh it against the differences between episodes
    with jax.enable_x64(True):
        state = add_episodes(init(PLAIN, (ScoreType.SUM,)), np.concatenate(rows), length, returns)
    state = jax.jit(fit_signs_in_float64)(state)  # compiled without float64, as in training
    means = np.stack([episode.mean(axis=0) for episode in rows])
    errors = {
        signs: (length * (means @ signs - returns / length) ** 2).sum()
        for signs in itertools.product((1.0, -1.0), repeat=3)
    }
    assert tuple(np.asarray(state.decoder.weight[0])) == min(errors, key=errors.get)
    assert float(state.decoder.bias[0]) == 0


def test_fit_recovers_a_product_of_raw_features():
    """Without pairs, at most half of the variation of the rewards could be explained. The factors are noise."""
    rows = np.random.default_rng(0).normal(size=(150 * 12, 4)).astype(np.float32)
    reward = rows[:, -1] * (0.7 + rows[:, -2])
    basis, returns = Basis(2, 2, extended=True), reward.reshape(150, 12).sum(axis=1)
    with jax.enable_x64(True):
        state = closed_form.reset_statistics(init(basis, (0, 1)), observed(rows))
        state = fit(add_episodes(state, rows, np.full(150, 12), returns), (0, 1), max_rounds=60)
        r_hat = select_score_type(state.decoder, 0)(jnp.asarray(rows)).r_hat
    assert np.corrcoef(r_hat, reward)[0, 1] > 0.99
    assert float(state.n_fitted) == 150


def test_is_due_and_is_stale():
    """After a reset, the old weights do not match the newly standardised features, though no episode is new."""
    state = init(PLAIN, (ScoreType.SUM,))
    assert not closed_form.is_due(state)
    reset = closed_form.reset_statistics(state._replace(n_fitted=jnp.array(100.0)), observed(np.ones((9, 3))))
    statistics = state.sufficient_statistics._replace(n_episodes=jnp.array([1.0, 0.0]))
    assert closed_form.is_due(state._replace(sufficient_statistics=statistics))
    statistics = statistics._replace(n_episodes=jnp.array([100.0, 0.0]))
    for n_fitted, due in ((0.0, True), (95.0, True), (96.0, False), (reset.n_fitted, True)):
        fitted = state._replace(sufficient_statistics=statistics, n_fitted=jnp.array(n_fitted))
        assert bool(closed_form.is_due(fitted)) == due
    for n_steps, stale in ((0.0, True), (66.0, True), (67.0, False)):
        assert (
            bool(closed_form.is_stale(state._replace(n_steps=jnp.array(n_steps)), observed(np.ones((100, 3))))) == stale
        )
