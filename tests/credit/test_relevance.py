from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lare_rl.credit import evidence, relevance
from lare_rl.credit.basis import Basis

pytestmark = pytest.mark.usefixtures("in_float64")

BASIS = Basis(n_factors=2, n_raw=10, extended=False)
MAX_EPISODES = 120


def episodes(count, relevant, noise, seed):
    """Return mean features and mean rewards of episodes of 10 steps. Factors say nothing; the first raw features matter."""
    random = np.random.default_rng(seed)
    weight = np.zeros(12)
    weight[2 : 2 + relevant] = random.choice([-1, 1], relevant) * random.uniform(0.5, 2, relevant)
    means = random.normal(size=(count, 12))
    return means, means @ weight + noise * random.normal(size=count), weight


@partial(jax.jit, static_argnames="basis")
def fits(means, mean_reward, length, basis=BASIS):
    statistics = evidence.add_episodes(evidence.empty_statistics(basis.n_features), means, mean_reward * length, length)
    indices = basis.group_index, basis.strength_index
    groups, separate = relevance.fit(statistics, 0, *indices, *map(evidence.init_posterior, indices), 60)
    _, again = relevance.fit(statistics, 0, *indices, groups, separate, 60)
    return groups, relevance.select(separate, groups, *indices), again, relevance.is_better(separate, groups)


def fit_episodes(means, mean_reward):
    """Pad to one number of episodes, so that the fit is compiled once."""
    padding = (0, MAX_EPISODES - len(means))
    length = np.pad(np.full(len(means), 10), padding)
    return fits(np.pad(means, (padding, (0, 0))), np.pad(mean_reward, padding), length)


def test_strength_index():
    basis = Basis(2, 3, extended=True)
    ends = np.cumsum(list(basis.group_sizes.values()))
    index = dict(zip(basis.group_sizes, np.split(basis.strength_index, ends[:-1]), strict=True))
    assert [sorted(set(values.tolist())) for values in index.values()] == [[0], [1], [2], [3, 4, 5], [6, 7, 8], [9]]
    assert index["shapes of raw features"].tolist() == [6, 7, 8] * 6  # one function of all features after the other
    assert Basis(3, 0, extended=True).strength_index.tolist() == Basis(3, 0, extended=True).group_index.tolist()


def test_few_relevant_features_get_strengths_of_their_own():
    means, mean_reward, weight = episodes(40, relevant=1, noise=0.3, seed=0)
    groups, refined, again, has_own = fit_episodes(means, mean_reward)
    assert bool(has_own)
    errors = [np.abs(np.asarray(fit.weight) - weight).sum() for fit in (groups, refined)]
    assert errors[1] < 0.5 * errors[0]
    n_effective = np.asarray(refined.n_effective)
    assert n_effective[1] > 0.9  # strength 0 is that of the factors
    assert np.median(n_effective[2:]) < 0.1
    np.testing.assert_allclose(again.weight, refined.weight, atol=1e-3)


def test_fit_by_groups_is_unchanged_without_a_gain():
    means, mean_reward, _ = episodes(40, relevant=10, noise=0.3, seed=1)
    groups, refined, _, has_own = fit_episodes(means, mean_reward)
    assert not bool(has_own)
    np.testing.assert_array_equal(refined.weight, groups.weight)
    np.testing.assert_allclose(refined.alpha, np.asarray(groups.alpha)[[0, *[1] * 10]])
    assert float(refined.n_effective.sum()) == pytest.approx(float(groups.n_effective.sum()))


@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([8, 15, 30, 100]),
    relevant=st.integers(0, 10),
    noise=st.sampled_from([0.0, 0.3, 2.0]),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_own_strengths_are_not_worse_than_groups(seed, count, relevant, noise):
    """The error of the weights, which is that of the rewards of later steps."""
    means, mean_reward, weight = episodes(count, relevant, noise, seed)
    groups, refined, *_ = fit_episodes(means, mean_reward)
    errors = [np.linalg.norm(np.asarray(fit.weight) - weight) for fit in (groups, refined)]
    assert errors[1] <= 1.2 * errors[0] + 0.1 + 0.5 * noise / np.sqrt(count)
