"""A graph computes any number of rows, each by itself, with NumPy and with JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.phi_programs import random_inputs, recorded_programs
from helpers.toy_envs import phi_source
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.read import read

PROGRAMS = {p.name: p for p in recorded_programs()[::60]}


def make_inputs(program, rows=24):
    return dict(zip(("observation", "action"), random_inputs(program.sizes, rows, dtype=np.float32), strict=True))


@pytest.mark.parametrize("name", PROGRAMS)
def test_rows_are_independent_in_any_batch_shape(name):
    program = PROGRAMS[name]
    graph, inputs = read(program.source, *program.sizes), make_inputs(program)
    factors = evaluate(graph, inputs)["factors"]
    shaped = evaluate(graph, {key: array.reshape(2, 3, 4, -1) for key, array in inputs.items()})["factors"]
    single = evaluate(graph, {key: array[5] for key, array in inputs.items()})["factors"]
    empty = evaluate(graph, {key: array[:0] for key, array in inputs.items()})["factors"]
    np.testing.assert_allclose(shaped.reshape(factors.shape), factors, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(single, factors[5], rtol=1e-5, atol=1e-5)
    assert empty.shape == (0, graph.n_factors)
    assert factors.dtype == np.float32


@pytest.mark.parametrize("name", list(PROGRAMS)[::2])
def test_jax_transformations_agree(name):
    program = PROGRAMS[name]
    graph, inputs = read(program.source, *program.sizes), make_inputs(program)

    def factors(inputs):
        return evaluate(graph, inputs, jnp)["factors"]

    expected = evaluate(graph, inputs)["factors"]
    np.testing.assert_allclose(jax.jit(factors)(inputs), expected, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(factors))(inputs), expected, rtol=1e-3, atol=1e-4)


def test_gradient_flows_through_factors():
    graph = read(
        "import numpy as np\n" + phi_source("return [np.sum(observation ** 2, axis=1, keepdims=True) * action]"), 3, 1
    )

    def factor(observation):
        return evaluate(graph, {"observation": observation, "action": jnp.ones(1)}, jnp)["factors"][0]

    np.testing.assert_allclose(jax.grad(factor)(jnp.array([1.0, 2.0, 3.0])), [2.0, 4.0, 6.0])


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("(observation[:, :1] > 0).astype(int) // 0", 0),
        ("np.array([5, 7])[(observation[:, :1] * 0 + 9).astype(int)]", 7),  # beyond the end: the last entry
        ("(observation[:, :1] * 0 + 1e20).astype(int)", 2**31 - 128),
        ("np.sum(observation[:, :2] > -99, axis=1, keepdims=True)", 2),
    ],
)
def test_integers_never_fail(expression, value):
    graph = read("import numpy as np\n" + phi_source(f"return [{expression}]"), 2, 1)
    inputs = {"observation": np.ones((2, 2), np.float32), "action": np.ones((2, 1), np.float32)}
    for xp in (np, jnp):
        np.testing.assert_array_equal(evaluate(graph, inputs, xp)["factors"], np.full((2, 1), value, np.float32))
