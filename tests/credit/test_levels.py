import jax
import numpy as np

from lare_rl.credit import levels
from lare_rl.credit.levels import empty_level_statistics


def sample(counts, between, within, seed=0):
    random = np.random.default_rng(seed)
    effects = between * random.normal(size=len(counts))
    level = np.repeat(np.arange(len(counts)), counts)
    order = random.permutation(len(level))
    return level[order], (5 + effects[level] + within * random.normal(size=len(level)))[order]


def numpy_offsets(level, y, n_levels):
    """The equations as they are written."""
    n = np.bincount(level, minlength=n_levels)
    means = np.array([y[level == g].mean() if (level == g).any() else 0 for g in range(n_levels)])
    total, used = n.sum(), (n > 0).sum()
    within = sum(((y[level == g] - means[g]) ** 2).sum() for g in range(n_levels)) / max(total - used, 1)
    between = max((n * (means - y.mean()) ** 2).sum() - (used - 1) * within, 0) / (total - (n**2).sum() / total)
    shrinkage = between / (between + within / np.maximum(n, 1))
    return np.where(n > 0, shrinkage * (means - y.mean()), 0)


add, offsets = jax.jit(levels.add_mean_rewards), jax.jit(levels.level_offsets)


def test_offsets_against_numpy():
    level, y = sample([2, 4, 0, 6], between=1.0, within=1.0)
    means = empty_level_statistics(4)
    for chunk in np.split(np.arange(len(y)), 3):
        ignored = np.arange(len(chunk) + 1) == len(chunk)
        means = add(means, np.append(level[chunk], 0), np.append(y[chunk], 1e6).astype(np.float32), ~ignored)
    expected = numpy_offsets(level, y, 4)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(offsets(means), expected, rtol=1e-3, atol=1e-4)
    level, y = sample([20] * 8, between=0.0, within=1.0)
    means = add(empty_level_statistics(8), level, y.astype(np.float32), np.ones(len(y), bool))
    assert np.abs(offsets(means)).max() < 0.2
    assert not np.asarray(offsets(empty_level_statistics(3))).any()
    one_each = add(empty_level_statistics(3), np.arange(3), np.array([0, 1, 5], np.float32), np.ones(3, bool))
    assert not np.asarray(offsets(one_each)).any()  # nothing tells chance from levels
