"""Factors of batches, and factors that are not finite."""

import numpy as np
import pytest

from helpers.toy_envs import PHI, phi_source
from lare_rl.latent import factors as factors_module
from lare_rl.latent.factors import compute_batch, find_nonfinite_operation
from lare_rl.phi.read import read


def random_steps(rows: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(rows)
    observation, action = rng.standard_normal((rows, 2)), rng.uniform(-1, 1, (rows, 1))
    return observation.astype(np.float32), action.astype(np.float32)


def test_compute_factors_in_chunks(monkeypatch):
    graph = read(PHI, 2, 1)
    monkeypatch.setattr(factors_module, "_CHUNK_NUMBERS", 10 * graph.size)
    for rows in (0, 1, 9, 10, 11, 64):
        observation, action = random_steps(rows)
        factors = compute_batch(graph, observation, action)
        assert factors.dtype == np.float32
        expected = [-np.square(action - observation[:, 0:1]), -np.square(action)]
        np.testing.assert_array_equal(factors, np.concatenate(expected, axis=1))


@pytest.mark.parametrize(
    ("body", "origin"),
    [
        ("x = action / 0\nreturn [observation[:, :1], np.tanh(x) + x]", ("divide", 2)),
        ("x = np.log(-np.square(action) - 1)\nreturn [np.exp(action), x]", ("log", 2)),
        ("x = np.log(-np.square(action) - 1)\nreturn [x, action]", None),
        ("return [action, action]", None),
    ],
)
def test_find_nonfinite_operation_of_the_second_factor(body, origin):
    assert find_nonfinite_operation(read(phi_source(body), 2, 1), 1, *random_steps(3)) == origin
