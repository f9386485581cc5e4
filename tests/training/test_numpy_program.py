"""Functions of JAX as NumPy programs: the same results, and what is not translated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.small_configs import small_config
from lare_rl.algorithms.registry import ALGORITHMS
from lare_rl.training import policy
from lare_rl.training.compiled import compile_functions, init_seeds
from lare_rl.training.numpy_program import UnsupportedOperationError, to_numpy
from lare_rl.training.streams import seed_keys

RNG = np.random.default_rng(0)


def draw(*shape):
    return RNG.normal(size=shape).astype(np.float32)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (lambda w, x: jnp.tanh(x @ w), (draw(4, 3), draw(5, 4))),
        (jax.vmap(lambda w, x: jax.nn.relu(x @ w)), (draw(2, 4, 3), draw(2, 5, 4))),
        (lambda w, x: jnp.einsum("ij,kj->ik", w, x), (draw(4, 3), draw(5, 3))),
        (lambda w, x: jnp.einsum("bij,bkjl->bkil", w, x), (draw(2, 4, 3), draw(2, 5, 3, 2))),
        (lambda w, x: jnp.einsum("ij,kj->ik", w, x), (draw(5, 0), draw(4, 0))),
        (lambda w, x: jnp.concatenate(jnp.split(x + w, 3, axis=-1)[::-1], axis=-1), (draw(6), draw(5, 6))),
        (lambda w, x: jnp.where(x > w, x, w)[:, 1:3], (draw(4), draw(5, 4))),
        (lambda w, x: jax.nn.one_hot(jnp.argmax(x * w, axis=-1), 4), (draw(4), draw(5, 4))),
        (lambda w, x: jax.nn.softmax(x / jnp.maximum(w, 0.1)), (draw(4), draw(5, 4))),
        (lambda w, x: jax.nn.sigmoid(x) * jnp.exp(jnp.clip(w, -1, 1)) + jnp.square(x), (draw(4), draw(5, 4))),
        (lambda w, x: (x.T.reshape(-1) ** 3).astype(jnp.int32) + jnp.arange(20), (draw(4), draw(5, 4))),
        (lambda w, x: {"sum": jnp.sum(x, axis=0), "any": jnp.any(x > 3), "first": x}, (draw(4), draw(5, 4))),
    ],
)
def test_program_equals_function(function, arguments):
    fixed, *inputs = arguments
    actual = to_numpy(function, fixed, *inputs)(fixed)(*inputs)
    expected = function(*arguments)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6), actual, expected)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), actual) == jax.tree.map(lambda x: (x.shape, x.dtype), expected)


@pytest.mark.parametrize(
    "function",
    [
        lambda w, x: jnp.sort(x + w),
        lambda w, x: jax.lax.fori_loop(0, 3, jnp.add, x),
        lambda w, x: jnp.bitwise_or.reduce(x.astype(int)),
        lambda w, x: jax.lax.div(x.astype(int), w.astype(int)),
        lambda w, x: jnp.dot(x.astype(jnp.int8), w.astype(jnp.int8), preferred_element_type=jnp.int32),
    ],
)
def test_other_operations_are_refused(function):
    with pytest.raises(UnsupportedOperationError):
        to_numpy(function, draw(4), draw(4))


def test_other_arguments_are_refused():
    program = to_numpy(lambda w, x: w * x, draw(4), draw(4))(draw(4))
    with pytest.raises(TypeError, match="arguments"):
        program(draw(4), draw(4))


@pytest.mark.parametrize("algorithm", ["td3", "sac", "ppo"])
def test_policy_on_host_equals_compiled_policy(algorithm, monkeypatch):
    hyperparameters = ALGORITHMS[algorithm].settings.model_copy(update={"hidden": (8,)})
    config = small_config("dense", algorithm, hyperparameters=hyperparameters)
    learner = init_seeds(compile_functions(config), seed_keys(jnp.arange(2), 0))
    actor = policy.get_actor(learner.algorithm, 0, config)
    inputs, greedy = ((), draw(2, 3, 1, 3), np.ones((2, 3, 1, 2), bool)), None
    for deterministic in (True, False):
        noise, results = None if deterministic else draw(2, 3, 1, config.noise_size), []
        assert policy._translate_policy(config, 2, 3, deterministic) is not None
        for _ in range(2):
            act = policy.make_host_policy(config, actor, 3, deterministic=deterministic)
            results.append(act(*inputs, noise, np.zeros((2, 3), bool))[0])
            monkeypatch.setattr(policy, "_translate_policy", lambda *_: None)
        np.testing.assert_allclose(*results, atol=1e-6)
        assert greedy is None or np.abs(results[0] - greedy).max() > 0.01  # the policy explores
        greedy = results[0]
        monkeypatch.undo()
