"""Factors of batches of any size, and those that are not finite."""

import numpy as np
import pytest

from helpers.programs import batch, by_graph, by_python
from helpers.toys import PHI, phi
from lare_rl.latent import factors as module
from lare_rl.latent.factors import LatentRewardError, check_finite, compute_factors, origin_of_infinity
from lare_rl.phi.read import read


def steps(rows: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(rows)
    return random.standard_normal((rows, 2)).astype(np.float32), random.uniform(-1, 1, (rows, 1)).astype(np.float32)


@pytest.mark.parametrize("rows", [0, 1, 3, 9, 10, 11, 64])
def test_compute_factors_in_chunks(rows, monkeypatch):
    graph = read(PHI, 2, 1)
    observation, action = steps(rows)
    monkeypatch.setattr(module, "CHUNK", 10 * graph.size)
    factors = compute_factors(graph, observation, action)
    assert factors.dtype == np.float32
    np.testing.assert_array_equal(
        factors, np.concatenate([-np.square(action - observation[:, 0:1]), -np.square(action)], axis=1)
    )


@pytest.mark.parametrize(
    "body",
    [
        "return [action[:, 0:1] > 0, (observation[:, 0:1] * 9).astype(int), observation[:, 0:1] / 3]",
        "return [np.linalg.norm(observation, axis=1, keepdims=True), np.median(action, 1, keepdims=True)]",
        "return [np.where(observation[:, 0] > 0, 1.0, math.pi)[:, None], observation.argmax(1)[:, None]]",
    ],
)
def test_compute_factors_as_python(body):
    source = f"import math\nimport numpy as np\n{phi(body)}"
    factors = by_graph(source)
    assert factors.dtype == np.float32
    np.testing.assert_allclose(factors, by_python(source), rtol=1e-6)


def test_compute_factors_of_each_row_alone():
    graph = read(phi("return [np.sum(observation * observation, axis=1, keepdims=True), action[:, :1] ** 3]"), 17, 6)
    observation, action = batch(50)
    each = [compute_factors(graph, observation[i : i + 1], action[i : i + 1]) for i in range(50)]
    np.testing.assert_allclose(compute_factors(graph, observation, action), np.concatenate(each), rtol=1e-6)


@pytest.mark.parametrize(
    ("factors", "message"),
    [([[1, 2], [np.nan, 3]], "factor 'a' is nan"), ([[1, np.inf], [np.nan, 3]], "factor 'b' is inf")],
)
def test_check_finite(factors, message):
    observation, action = steps(2)
    check_finite(np.ones((2, 2), np.float32), ["a", "b"], observation, action)
    with pytest.raises(
        LatentRewardError, match=f"^the latent function failed: {message} for the observation "
    ) as error:
        check_finite(np.array(factors, np.float32), ["a", "b"], observation, action)
    assert error.value.observation is observation
    assert error.value.action is action


@pytest.mark.parametrize(
    ("body", "origin"),
    [
        ("x = action / 0\nreturn [observation[:, :1], np.tanh(x) + x]", ("divide", 2)),
        ("x = np.log(-np.square(action) - 1)\nreturn [np.exp(action), x]", ("log", 2)),
        ("x = np.log(-np.square(action) - 1)\nreturn [x, action]", None),
        ("return [action, action]", None),
    ],
)
def test_origin_of_infinity_of_the_second_factor(body, origin):
    assert origin_of_infinity(read(phi(body), 2, 1), 1, *steps(3)) == origin
