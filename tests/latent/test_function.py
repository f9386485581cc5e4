"""The latent function: its source, its graph and its factors."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from helpers.toy_envs import PHI, phi_source
from lare_rl.errors import LareError
from lare_rl.latent.factors import NonFiniteFactorError
from lare_rl.latent.function import check_task, normalise_source, pair_with_roles, verify_function
from lare_rl.latent.verify import Check
from lare_rl.phi.limits import RefusedError

SOURCE = PHI.strip("\n")


def test_verify_function(verified, chase):
    assert (verified.task, verified.kind, verified.source, verified.size) == ("Chase", "factors", SOURCE, 2)
    assert verified.sizes == (2, 1)
    assert (verified.model, verified.exchanges) == ("none: written by hand", ())
    assert verified.checks == (Check("read", True, ""), Check("finite", True, ""))
    assert verify_function(f"\n{PHI}\n", chase) == verified


def test_factors_and_pickle(function):
    observation, action = np.array([[1, 9], [0.5, 9]], np.float32), np.array([[3], [-0.5]], np.float32)
    factors = function(observation, action)
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(factors, [[-4, -9], [-1, -0.25]])
    np.testing.assert_array_equal(function(observation[0], action[0]), factors[0])
    other = pickle.loads(pickle.dumps(function))
    assert other == function
    assert hash(other) == hash(function)
    assert "graph" not in other.__dict__
    np.testing.assert_array_equal(other(observation, action), factors)
    with pytest.raises(RefusedError, match="E-FORM"):
        _ = replace(function, source="x = 1").graph


@pytest.mark.parametrize(
    ("scored_observation", "columns", "expected"),
    [
        ("before", ["f_near", "f_effort"], [[-4, -9]]),
        ("after", ["f_near", "f_effort"], [[-1, -9]]),
        ("both", ["f_near (before)", "f_effort (before)", "f_near (after)", "f_effort (after)"], [[-4, -9, -1, -9]]),
    ],
)
def test_step_factors(function, scored_observation, columns, expected):
    factors = function.step_factors([[1, 0]], [[3]], [[2, 0]], scored_observation)
    np.testing.assert_array_equal(factors, expected)
    assert function.factor_columns(scored_observation) == columns
    assert function.n_factors(scored_observation) == len(columns)
    empty = function.step_factors(np.zeros((0, 2)), np.zeros((0, 1)), np.zeros((0, 2)), scored_observation)
    assert empty.shape == (0, len(columns))
    observation, action = np.arange(12.0).reshape(2, 3, 2), np.arange(6.0).reshape(2, 3, 1)
    factors = function.step_factors(observation, action, -observation, scored_observation)
    assert factors.shape == (2, 3, len(columns))
    row = function.step_factors(observation[1, 0], action[1, 0], -observation[1, 0], scored_observation)
    np.testing.assert_array_equal(factors[1, 0], row)


def test_factor_that_is_not_finite_in_use(chase):
    # The function passes on the steps of its verification.
    observation, action = np.zeros((5, 2), np.float32), np.ones((5, 1), np.float32)
    observation[4, 0] = -6000
    function = verify_function(phi_source("near = np.sqrt(observation[:, 0:1] + 5000)\nreturn [action, near]"), chase)
    with pytest.raises(NonFiniteFactorError, match=r"'near' is nan .*-6000") as error:
        function(observation, action)
    np.testing.assert_array_equal(error.value.observation, observation)
    np.testing.assert_array_equal(error.value.action, action)
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)


def test_normalise_source():
    assert normalise_source("# lare: x\r\n\n  y\rz\x0c\x85\n\n") == "  y\nz\x0c\x85"
    assert normalise_source("x  # \u26a0\ufe0f sign") == "x  # \u26a0 sign"
    assert normalise_source("# lare: \n\n" * 60_000 + "\nx\n\n") == "x"  # quadratic time would take minutes


def test_function_of_another_task(function, chase):
    other = chase.model_copy(update={"name": "Depot"})
    check_task(function, chase)
    with pytest.raises(LareError, match=r"'Chase', not for 'Depot'.*task='Depot'"):
        check_task(function, other)
    with pytest.raises(LareError, match=r"\(2, 1\), and Chase has \(3, 1\)"):
        check_task(function, chase.model_copy(update={"observation_size": 3}))
    assert pair_with_roles([function], chase) == [(function, chase)]
    with pytest.raises(LareError, match="each of Chase; 2 were given"):
        pair_with_roles([function, function], chase)
