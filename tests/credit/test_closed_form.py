"""The linear decoder, the storage of its statistics, when it is fitted, and the signs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Var

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.nn.normalise import empty_mean_std, update_mean_std

PLAIN = Basis(3, 0, extended=False)


def sample_episodes(count=20, seed=0, noise=0.0):
    """Return factors of steps, lengths, and returns of the signed sum with signs (1, -1, -1)."""
    random = np.random.default_rng(seed)
    length = random.integers(3, 9, size=count)
    rows = [random.normal(size=(T, 3)) + random.normal(size=3) + 5 for T in length]
    returns = [(episode @ [1.0, -1.0, -1.0]).sum() + noise * random.normal() for episode in rows]
    return rows, length, np.array(returns)


def add_episodes(state, rows, length, returns):
    means = np.stack([np.asarray(state.decoder.features(jnp.asarray(episode))).mean(axis=0) for episode in rows])
    statistics = closed_form.to_float64(state.sufficient_statistics)
    statistics = evidence.add_episodes(statistics, *map(jnp.asarray, (means, returns, length)))
    return state._replace(sufficient_statistics=closed_form.split_double(statistics))


def observed(rows):
    rows = np.concatenate(rows)
    return update_mean_std(empty_mean_std(rows.shape[1]), jnp.asarray(rows, jnp.float32))


def test_linear_decoder_by_hand():
    basis = Basis(1, 2, extended=True)
    weight = np.random.default_rng(0).normal(size=basis.n_features).astype(np.float32)
    mean, std = np.array([1.0, 2.0, 3.0], np.float32), np.array([2.0, 0.0, 0.5], np.float32)
    decoder = LinearDecoder(basis, *map(jnp.asarray, (mean, std, weight)), jnp.array(0.25))
    rows = np.random.default_rng(1).normal(size=(5, 4, 3)).astype(np.float32)
    u = np.stack([(rows[..., 0] - 1) / 2, np.zeros((5, 4)), (rows[..., 2] - 3) / 0.5], axis=-1)
    want = np.asarray(expand(basis, jnp.asarray(u, jnp.float32))) @ weight + 0.25
    np.testing.assert_allclose(decoder(jnp.asarray(rows)).r_hat, want, rtol=1e-5, atol=1e-5)


def evaluate_without_rounding(function, *args):
    """Evaluate as XLA does on a GPU: a conversion to float32 and back does not round."""
    program = jax.make_jaxpr(function)(*args)
    values = dict(zip(program.jaxpr.invars, jax.tree.leaves(args), strict=True))
    originals = {}
    for equation in program.jaxpr.eqns:
        inputs = [values[x] if isinstance(x, Var) else x.val for x in equation.invars]
        if equation.primitive.name == "convert_element_type":
            (result,) = equation.outvars
            originals[result] = originals.get(equation.invars[0], inputs[0])
            values[result] = originals[result].astype(equation.params["new_dtype"])
        else:
            output = equation.primitive.bind(*inputs, **equation.params)
            outputs = output if equation.primitive.multiple_results else [output]
            values.update(zip(equation.outvars, outputs, strict=True))
    return [values[x] for x in program.jaxpr.outvars]


@pytest.mark.parametrize("gpu", [False, True], ids=["cpu", "gpu"])
def test_split_double_keeps_float64(gpu):
    with jax.enable_x64(True):
        numbers = jnp.asarray(1e6 + np.random.default_rng(0).normal(size=10))
        statistics = evidence.empty_statistics(8)._replace(mean=numbers)
        stored = closed_form.split_double(statistics)
        if gpu:
            stored = type(stored)(*evaluate_without_rounding(closed_form.split_double, statistics))
        assert {leaf.dtype for leaf in stored} == {np.dtype(np.float32)}
        np.testing.assert_allclose(closed_form.to_float64(stored).mean, numbers, rtol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_fit_signs_against_trying_all(seed):
    rows, length, returns = sample_episodes(seed=seed, noise=30.0)
    with jax.enable_x64(True):
        state = closed_form.fit_signs(add_episodes(closed_form.init(PLAIN, 1), rows, length, returns))
    means = np.stack([episode.mean(axis=0) for episode in rows])
    errors = {
        signs: (length * (means @ signs - returns / length) ** 2).sum()
        for signs in itertools.product((1.0, -1.0), repeat=3)
    }
    assert tuple(np.asarray(state.decoder.weight[0])) == min(errors, key=errors.get)
    assert float(state.decoder.bias[0]) == 0


def test_fit_recovers_rewards_of_standardised_factors():
    rows, length, returns = sample_episodes(count=60)
    with jax.enable_x64(True):
        state = closed_form.reset_statistics(closed_form.init(PLAIN, 2), observed(rows))
        state = closed_form.fit(add_episodes(state, rows, length, returns), (0, 1), max_rounds=60)
        r_hat = closed_form.select_score_type(state.decoder, 0)(jnp.asarray(np.concatenate(rows), jnp.float32)).r_hat
    np.testing.assert_allclose(r_hat, np.concatenate(rows) @ [1.0, -1.0, -1.0], atol=1e-3)
    assert float(state.n_fitted) == 60


@pytest.mark.parametrize("n_factors", [0, 2])
def test_fit_recovers_a_product_of_raw_features(n_factors):
    """Without pairs, at most half of the variation of the rewards could be explained. The factors are noise."""
    random = np.random.default_rng(0)
    rows = [random.normal(size=(12, 2 + n_factors)) for _ in range(150)]
    reward = [episode[:, -1] * (0.7 + episode[:, -2]) for episode in rows]
    with jax.enable_x64(True):
        state = closed_form.init(Basis(n_factors, 2, extended=True), 1)
        state = closed_form.reset_statistics(state, observed(rows))
        state = add_episodes(state, rows, np.full(150, 12), np.array([episode.sum() for episode in reward]))
        state = closed_form.fit(state, (0,), max_rounds=60)
        r_hat = closed_form.select_score_type(state.decoder, 0)(jnp.asarray(np.concatenate(rows), jnp.float32)).r_hat
    assert np.corrcoef(r_hat, np.concatenate(reward))[0, 1] > 0.99


@pytest.mark.parametrize(("n_fitted", "due"), [(0.0, True), (95.0, True), (96.0, False)])
def test_is_due(n_fitted, due):
    state = closed_form.init(PLAIN, 1)
    assert not closed_form.is_due(state)
    statistics = state.sufficient_statistics._replace(n_episodes=jnp.array([100.0, 0.0]))
    state = state._replace(sufficient_statistics=statistics, n_fitted=jnp.array(n_fitted))
    assert bool(closed_form.is_due(state)) == due


@pytest.mark.parametrize(("n_steps", "stale"), [(0.0, True), (66.0, True), (67.0, False)])
def test_is_stale(n_steps, stale):
    state = closed_form.init(PLAIN, 1)._replace(n_steps=jnp.array(n_steps))
    assert bool(closed_form.is_stale(state, observed([np.ones((100, 3))]))) == stale
