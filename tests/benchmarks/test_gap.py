import numpy as np

import gap


def test_interquartile_mean_drops_the_outer_quarters():
    assert gap.interquartile_mean(np.array([100.0, 1.0, 2.0, -100.0])) == 1.5


def test_references_have_the_shares_zero_and_one():
    low, high = np.array([-3.0, -1.0]), np.array([6.0, 10.0])
    assert gap.mean_share([gap.Sample(low, low, high)]) == 0
    assert gap.mean_share([gap.Sample(high, low, high)]) == 1
