import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from lare_rl.compare import bootstrap
from lare_rl.compare.bootstrap import (
    interquartile_mean,
    mann_whitney,
    performance_profile,
    probability_of_improvement,
    two_sided_p,
)

SCORES = np.array([[4.0, 0.5], [2.0, 2.5], [7.0, 1.5], [1.0, 3.0], [9.0, 1.5]])
BASELINE = np.array([[3.0, 1.5], [2.0, 0.0], [5.0, 2.0]])
THRESHOLDS = np.array([1.0, 2.0, 4.0])


def profile(scores):
    return performance_profile(scores, THRESHOLDS)


def difference(scores, baseline):
    return interquartile_mean(scores) - interquartile_mean(baseline)


def slow_interquartile_mean(scores):
    numbers = sorted(number for run in scores.tolist() for number in run)
    middle = [number for i, number in enumerate(numbers) if len(numbers) // 4 <= i < len(numbers) - len(numbers) // 4]
    return sum(middle) / len(middle)


def test_interquartile_mean_of_any_number_of_runs():
    for n_runs in range(1, 10):
        scores = np.random.default_rng(n_runs).normal(size=(4, n_runs, 3))
        np.testing.assert_allclose(interquartile_mean(scores), list(map(slow_interquartile_mean, scores)))


# The numbers of rliable 1.2.0. For the first, `pip install 'rliable==1.2.0' 'pandas<3'`, and in Python
#     import numpy as np
#     from rliable import library, metrics
#     np.random.seed(0)
#     library.get_interval_estimates({"": SCORES}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=2000)
# and for the others, with the seed set before each of them,
#     {"": SCORES}, lambda x: library.score_distributions(x, THRESHOLDS)
#     {"": (SCORES, BASELINE)}, lambda x, y: np.array([metrics.probability_of_improvement(x, y)])
#     {"": (SCORES, BASELINE)}, lambda x, y: np.array([metrics.aggregate_iqm(x) - metrics.aggregate_iqm(y)])
@pytest.mark.parametrize(
    ("function", "scores", "value", "low", "high"),
    [
        (interquartile_mean, [SCORES], 2.4166666666666665, 1.4166666666666667, 4.416666666666667),
        (profile, [SCORES], [0.8, 0.5, 0.2], [0.5, 0.2, 0.0], [1.0, 0.8, 0.4]),
        (probability_of_improvement, [SCORES, BASELINE], 0.6166666666666667, 0.31666666666666665, 0.9),
        (difference, [SCORES, BASELINE], 0.2916666666666665, -1.0833333333333333, 2.3343749999999943),
    ],
)
def test_numbers_of_rliable(function, scores, value, low, high, monkeypatch):
    """The number of samples is no multiple of a chunk."""
    monkeypatch.setattr(bootstrap, "REPETITIONS", 2000)
    monkeypatch.setattr(bootstrap, "CHUNK", 300)
    intervals = bootstrap.bootstrap(function, *scores)
    for numbers, expected in zip(intervals, (value, low, high), strict=True):
        np.testing.assert_allclose(numbers, expected, rtol=1e-12, atol=1e-14)


def test_mann_whitney_by_hand():
    """By the tables of Mann and Whitney: of 3 against 3, all nine pairs 1 in 20, eight or more 2 in 20."""
    low, high = np.array([1.0, 2, 3]), np.array([4.0, 5, 6])
    assert mann_whitney([(high, low)]) == pytest.approx((1 / 20, 1))
    assert mann_whitney([(np.array([3.0, 5, 6]), np.array([1.0, 2, 4]))])[0] == pytest.approx(2 / 20)
    assert mann_whitney([(low, high)]) == pytest.approx((1, 1 / 20))
    assert mann_whitney([(high, low), (high, low)])[0] == pytest.approx(1 / 400)
    assert min(mann_whitney([(low, low)])) > 0.5
    assert (two_sided_p([(low, high)]), two_sided_p([(low, low)])) == (pytest.approx(2 / 20), 1.0)


def test_mann_whitney_of_many_seeds():
    """As SciPy's exact test, which has no ties, and symmetric where all values are equal."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.5, size=30), rng.normal(size=25)
    expected = [mannwhitneyu(a, b, alternative=side, method="exact").pvalue for side in ("greater", "less")]
    assert mann_whitney([(a, b)]) == pytest.approx(expected)
    assert mann_whitney([(np.zeros(10), np.zeros(10))]) == pytest.approx((1, 1))
    assert mann_whitney([(np.array([1.0, 1]), np.array([1.0, 0]))])[0] == pytest.approx(1 / 2)
