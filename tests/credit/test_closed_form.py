"""The decoder itself, what is kept of the sums, when it is fitted again, and the signs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Var

from lare_rl.credit import closed_form, evidence
from lare_rl.credit.basis import Basis, expand
from lare_rl.credit.closed_form import LinearDecoder
from lare_rl.nn.normalise import new_mean_std, observe

PLAIN = Basis(3, 0, extended=False)


def episodes(count=20, seed=0, noise=0.0):
    """Factors of steps, lengths, and returns that a sum with signs (1, -1, -1) makes."""
    random = np.random.default_rng(seed)
    length = random.integers(3, 9, size=count)
    rows = [random.normal(size=(T, 3)) + random.normal(size=3) + 5 for T in length]
    returns = [(one @ [1.0, -1.0, -1.0]).sum() + noise * random.normal() for one in rows]
    return rows, length, np.array(returns)


def with_episodes(state, rows, length, returns):
    means = np.stack([np.asarray(state.decoder.features(jnp.asarray(one))).mean(axis=0) for one in rows])
    sums = evidence.add_episodes(closed_form.whole(state.summed), *map(jnp.asarray, (means, returns, length)))
    return state._replace(summed=closed_form.kept(sums))


def test_the_decoder_by_hand():
    basis = Basis(1, 2, extended=True)
    weight = np.random.default_rng(0).normal(size=basis.size).astype(np.float32)
    mean, deviation = np.array([1.0, 2.0, 3.0], np.float32), np.array([2.0, 0.0, 0.5], np.float32)
    decoder = LinearDecoder(basis, *map(jnp.asarray, (mean, deviation, weight)), jnp.array(0.25))
    rows = np.random.default_rng(1).normal(size=(5, 4, 3)).astype(np.float32)
    u = np.stack([(rows[..., 0] - 1) / 2, np.zeros((5, 4)), (rows[..., 2] - 3) / 0.5], axis=-1)
    want = np.asarray(expand(basis, jnp.asarray(u, jnp.float32))) @ weight + 0.25
    np.testing.assert_allclose(decoder(jnp.asarray(rows)).r_hat, want, rtol=1e-5, atol=1e-5)


def test_two_numbers_of_float32_keep_one_of_float64():
    with jax.enable_x64(True):
        sums = jax.tree.map(lambda leaf: leaf + 1 / 3 + 1e6 * jnp.ones(leaf.shape), evidence.no_sums(2))
        held = closed_form.kept(sums)
        assert {leaf.dtype for leaf in held} == {np.dtype(np.float32)}
        for a, b in zip(closed_form.whole(held), sums, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14)


def without_roundings(function, *arguments):
    """Evaluate as XLA does on a GPU: a number that is converted to another float and then to a third one is not rounded between."""
    program = jax.make_jaxpr(function)(*arguments)
    known = dict(zip(program.jaxpr.invars, jax.tree.leaves(arguments), strict=True))
    converted = {}
    for equation in program.jaxpr.eqns:
        given = [known[one] if isinstance(one, Var) else one.val for one in equation.invars]
        if equation.primitive.name == "convert_element_type":
            (result,) = equation.outvars
            converted[result] = converted.get(equation.invars[0], given[0])
            known[result] = converted[result].astype(equation.params["new_dtype"])
        else:
            found = equation.primitive.bind(*given, **equation.params)
            known.update(zip(equation.outvars, found if equation.primitive.multiple_results else [found], strict=True))
    return [known[one] for one in program.jaxpr.outvars]


def test_two_numbers_of_float32_keep_one_of_float64_on_a_gpu():
    with jax.enable_x64(True):
        numbers = jnp.asarray(np.random.default_rng(0).normal(size=10))
        sums = evidence.no_sums(8)._replace(mean=numbers)
        held = evidence.Sums(*without_roundings(closed_form.kept, sums))
        np.testing.assert_allclose(closed_form.whole(held).mean, numbers, rtol=1e-14)

        def converted(number):
            return number - number.astype(np.float32).astype(float)

        assert np.all(converted(numbers))
        assert not np.any(without_roundings(converted, numbers)[0])


@pytest.mark.parametrize("seed", range(4))
def test_signs_against_trying_all(seed):
    rows, length, returns = episodes(seed=seed, noise=30.0)
    with jax.enable_x64(True):
        state = with_episodes(closed_form.init(PLAIN, 1), rows, length, returns)
        found = closed_form.fit_signs(state)
    means = np.stack([one.mean(axis=0) for one in rows])
    errors = {
        signs: (length * (means @ signs - returns / length) ** 2).sum()
        for signs in itertools.product((1.0, -1.0), repeat=3)
    }
    assert tuple(np.asarray(found.decoder.weight[0])) == min(errors, key=errors.get)
    assert float(found.decoder.bias[0]) == 0


def test_rewards_are_found_whatever_the_factors_are_standardised_by():
    rows, length, returns = episodes(count=60)
    every = jnp.asarray(np.concatenate(rows), jnp.float32)
    with jax.enable_x64(True):
        state = closed_form.begin_again(closed_form.init(PLAIN, 2), observe(new_mean_std(3), every))
        found = closed_form.fit(with_episodes(state, rows, length, returns), (0, 1), rounds=60)
        r_hat = closed_form.of_form(found.decoder, 0)(every).r_hat
    np.testing.assert_allclose(r_hat, np.concatenate(rows) @ [1.0, -1.0, -1.0], atol=1e-3)
    assert float(found.fitted) == 60


@pytest.mark.parametrize("factors", [0, 2])
def test_a_product_of_raw_entries_is_found(factors):
    """Price times power: without pairs of entries, half of the variation of the rewards at most would be explained."""
    random = np.random.default_rng(0)
    rows = [random.normal(size=(12, 2 + factors)) for _ in range(150)]  # a phi, if any, of noise
    paid = [one[:, -1] * (0.7 + one[:, -2]) for one in rows]
    every, length = np.concatenate(rows), np.full(len(rows), 12)
    with jax.enable_x64(True):
        state = closed_form.init(Basis(factors, 2, extended=True), 1)
        state = closed_form.begin_again(state, observe(new_mean_std(2 + factors), jnp.asarray(every, jnp.float32)))
        state = with_episodes(state, rows, length, np.array([one.sum() for one in paid]))
        found = closed_form.fit(state, (0,), rounds=60)
        r_hat = closed_form.of_form(found.decoder, 0)(jnp.asarray(every, jnp.float32)).r_hat
    assert np.corrcoef(r_hat, np.concatenate(paid))[0, 1] > 0.99


def test_when_it_is_fitted_again():
    state = closed_form.init(PLAIN, 1)
    told = state.summed._replace(episodes=jnp.array([100.0, 0.0]))
    due = {at: bool(closed_form.is_due(state._replace(summed=told, fitted=jnp.array(at)))) for at in (0.0, 95.0, 96.0)}
    assert due == {0.0: True, 95.0: True, 96.0: False}
    assert not closed_form.is_due(state)


def test_when_all_is_summed_again():
    rows = observe(new_mean_std(3), jnp.ones((100, 3)))
    state = closed_form.init(PLAIN, 1)
    stale = {at: bool(closed_form.is_stale(state._replace(steps=jnp.array(at)), rows)) for at in (0.0, 66.0, 67.0)}
    assert stale == {0.0: True, 66.0: True, 67.0: False}
