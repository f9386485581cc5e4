"""How well factors would have told returns, each before it was seen."""

from itertools import pairwise

import jax
import numpy as np
import pytest

from lare_rl.credit.basis import Basis
from lare_rl.credit.factor_fit import FIRST, features_of, growing, judge, predictions, r2_and_error
from lare_rl.credit.returns import FormFound

BASIS = Basis(2, 3, extended=True)


def played(form="sum", count=60, seed=0, agents=1, noise=0.0):
    """Episodes of 5 to 20 steps of rows [z, s', a]; what is paid is twice the first factor, less the second."""
    random = np.random.default_rng(seed)
    rows = [random.normal(size=(random.integers(5, 21), agents, BASIS.inputs)) for _ in range(count)]
    rows = [(one + random.normal(size=BASIS.inputs)).astype(np.float32) for one in rows]
    alive = [np.ones(one.shape[:2], bool) for one in rows]
    mean = np.array([(one[..., :2] @ [2.0, -1.0]).mean() for one in rows])
    length = np.array([len(one) for one in rows])
    returns = (mean + noise * random.normal(size=count)) * (length if form == "sum" else 1)
    return rows, alive, returns


def test_factors_that_tell_the_score_are_preferred():
    rows, alive, returns = played()
    other = [np.concatenate([one[..., 3:5], one[..., 2:]], axis=-1) for one in rows]
    assert judge(rows, alive, returns, BASIS).r2 > 0.95
    assert judge(other, alive, returns, BASIS).r2 < 0.5


def test_no_return_is_seen_before_it_is_predicted():
    rows, alive, returns = played(noise=0.3)
    length = np.array([len(one) for one in rows])
    with jax.enable_x64(True):
        means = features_of(rows, alive, BASIS)[0][:, BASIS.of_factors]
        changed = np.where(np.arange(len(rows)) < 40, returns, -returns)
        one, other = (predictions(means, paid, length, BASIS, 0) for paid in (returns, changed))
    # The block of episode 40 is predicted as a whole.
    known = next(end for _, end in growing(len(rows)) if end > 40) - FIRST
    np.testing.assert_array_equal(one[:known], other[:known])
    assert (one[known:] != other[known:]).all()


@pytest.mark.parametrize("noise", [0.2, 0.7, 1.2])
def test_the_error_of_r2_is_its_deviation_from_sample_to_sample(noise):
    random = np.random.default_rng(0)
    returns = random.normal(3, 2, size=(1000, 40))
    found = np.array([r2_and_error(one, one + noise * random.normal(0, 2, 40)) for one in returns])
    assert np.median(found[:, 1]) == pytest.approx(found[:, 0].std(), rel=0.15)
    assert found[:, 0].mean() == pytest.approx(1 - noise**2 * 40 / 37, abs=0.03)


@pytest.mark.parametrize("returns", [[], [5.0], [5.0] * 12, [1e6] * 11 + [1e6 + 1e-9]])
def test_equal_returns_have_no_r2(returns):
    assert np.isnan(r2_and_error(np.array(returns), np.zeros(len(returns)))).all()


@pytest.mark.parametrize("form", ["sum", "average"])
def test_the_form_is_found_or_given(form):
    rows, alive, returns = played(form)
    found = judge(rows, alive, returns, BASIS)
    assert found.form == FormFound(form == "average", decided=True)
    given = judge(rows, alive, returns, BASIS, form)
    assert (given.form, given.r2) == (None, found.r2)
    assert judge(rows, alive, returns, BASIS, {"sum": "average", "average": "sum"}[form]).r2 < found.r2


def test_lengths_alone_predict_the_score_of_equal_steps():
    rows, alive, _ = played()
    length = np.array([len(one) for one in rows])
    found = judge(rows, alive, 3.0 * length, BASIS, "sum")
    assert found.r2_of_lengths == pytest.approx(1)
    assert found.r2 > 0.99
    zero_mean = judge(*played(), BASIS)
    assert zero_mean.r2_of_lengths < zero_mean.r2 - 0.3
    assert judge(*played("average"), BASIS).r2_of_lengths is None
    equal = judge([one[:5] for one in rows], [one[:5] for one in alive], 3.0 * length, BASIS)
    assert equal.r2_of_lengths is None


def test_agents_who_have_left_do_not_count():
    rows, alive, _ = played(agents=2)
    changed = [np.concatenate([one, np.full_like(one[:, :1], 9.0)], axis=1) for one in rows]
    there = [np.concatenate([one, np.zeros_like(one[:, :1])], axis=1) for one in alive]
    with jax.enable_x64(True):
        (one, steps), (other, of_other) = (features_of(*given, BASIS) for given in ((rows, alive), (changed, there)))
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    for sums, others in zip(steps, of_other, strict=True):
        np.testing.assert_allclose(sums, others, rtol=1e-4, atol=1e-3)
    assert int(steps.number) == sum(map(np.sum, alive))


def test_few_episodes_say_nothing():
    rows, alive, returns = played(count=FIRST)
    assert np.isnan(judge(rows, alive, returns, BASIS).r2)


@pytest.mark.parametrize("count", [1, FIRST, FIRST + 1, 200])
def test_blocks_follow_each_other(count):
    blocks = list(growing(count))
    assert (blocks[0][0], blocks[-1][1]) == (0, count)
    assert all(end == start for (_, end), (start, _) in pairwise(blocks))
    assert len(blocks) <= 1 + max(0, count - FIRST)
