import numpy as np
import pytest
from jaxtyping import TypeCheckError

from lare_rl.util.statistics import (
    column_correlations,
    correlation,
    format_mean_std,
    format_plus_minus,
    r_squared,
    round_shares,
    sample_std,
    standard_error,
)


def test_shapes_are_checked():
    """In all rooms that `pyproject.toml` names."""
    with pytest.raises(TypeCheckError, match="values"):
        sample_std(np.zeros((2, 2)))


def test_std_of_single_value():
    assert (sample_std(np.array([3.0])), standard_error(np.zeros(0))) == (0, 0)
    assert sample_std(np.array([1.0, 3.0])) == pytest.approx(np.sqrt(2))
    assert standard_error(np.array([1.0, 3.0])) == pytest.approx(1)


def test_correlation():
    x = np.arange(4.0)
    assert correlation(x, -3 * x + 1) == pytest.approx(-1)
    assert np.isnan(correlation(x[:1], x[:1]))
    columns = np.stack([x, np.ones(4), x**2], axis=1)
    np.testing.assert_allclose(column_correlations(columns, x), [1, np.nan, np.corrcoef(x, x**2)[0, 1]])


def test_r_squared():
    y, predicted = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 2.0])
    r2, error = r_squared(y, predicted)
    assert r2 == pytest.approx(0.5)
    # e = 0 0 1, d = 1 0 1, and the linearised residuals are -0.5 0 0.5.
    assert error == pytest.approx(np.sqrt(3 / 2 * 0.5 / 4))
    assert np.isnan(r_squared(np.ones(3), predicted)).all()
    assert np.isnan(r_squared(y[:1], predicted[:1])).all()


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [
        (4576.2, 349.1, "4576 ± 349"),
        (71.0, 1.4, "71.00 ± 1.40"),
        (0.4505, 0.115, "0.451 ± 0.115"),
        (0.0002, 0.00021, "0.000200 ± 0.000210"),
        (1.23e-7, 4e-8, "1.23e-07 ± 4.00e-08"),
        (12.345, None, "12.35"),
    ],
)
def test_format_plus_minus(mean, std, text):
    assert format_plus_minus(mean, std) == text


def test_format_mean_std():
    assert format_mean_std(np.array([70.0, 72.0])) == "71.00 ± 1.41"
    assert format_mean_std(np.array([70.0])) == "70.00"
    assert format_mean_std(np.array([np.inf, 1.0])) == "inf ± nan"  # a measure may be infinite


@pytest.mark.parametrize(
    ("shares", "total", "rounded"),
    [
        ([1 / 3, 1 / 3, 1 / 3], 1.0, [0.34, 0.33, 0.33]),
        ([0.005, 0.995], 1.0, [0.01, 0.99]),
        ([0.905, 0.004, 0.091], 1.0, [0.91, 0.0, 0.09]),
        ([0.256, -0.104, 0.448], 0.6, [0.26, -0.11, 0.45]),
        ([], 0.0, []),
    ],
)
def test_round_shares(shares, total, rounded):
    assert round_shares(shares, total) == pytest.approx(rounded)
