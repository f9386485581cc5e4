import numpy as np

from lare_rl.credit.engine import correction


def test_correction_adds_the_residual_once():
    residual, length, last = np.full(4, 2.0), np.full(4, 4), np.arange(4) == 3
    assert np.asarray(correction(residual, last, length, "last")).tolist() == [0, 0, 0, 2]
    assert np.asarray(correction(residual, last, length, "spread")).tolist() == [0.5] * 4
