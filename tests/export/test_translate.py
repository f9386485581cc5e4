"""Functions of JAX as graphs."""

import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.errors import LareError
from lare_rl.export.translate import add_function, finish, graph_input
from lare_rl.phi.builder import Builder, building
from lare_rl.phi.evaluate import evaluate


def translate(function):
    with building(Builder()):
        return finish(y=add_function(lambda inputs: function(inputs["x"]), {"x": graph_input("x", (3,))}))


@pytest.mark.parametrize(
    "function",
    [lambda x: x[jnp.array([2, 0, 0])], lambda x: jnp.tanh(x).sum(), lambda x: x.at[jnp.array([0, 2])].get()],
)
def test_translated_function(function):
    x = np.array([[1.0, 2.0, 3.0]], np.float32)
    np.testing.assert_allclose(evaluate(translate(function), {"x": x})["y"][0], function(jnp.asarray(x[0])), rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "operation"),
    [
        (jnp.sort, "sort"),
        (lambda x: x[jnp.argmax(x)], "dynamic_slice|gather"),
        (lambda x: jnp.take(x, jnp.array([0, 7]), mode="fill"), "gather outside of an array"),
    ],
)
def test_operation_that_is_not_translated(function, operation):
    with pytest.raises(LareError, match=f"operation '.*({operation})"):
        translate(function)
