"""Probabilities of stochastic policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.algorithms.policies import StochasticPolicy
from lare_rl.nn.networks import MLP


def choosing(actions):
    return StochasticPolicy(MLP(3, (16,), actions, key=jax.random.key(0)), None)


def test_a_choice_has_the_probabilities_of_its_softmax():
    policy = choosing(2)
    observation = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)), jnp.float32)
    both = jnp.stack([policy.log_probability(observation, jnp.tile(jnp.eye(2)[i], (5, 1))) for i in range(2)])
    np.testing.assert_allclose(np.exp(both).sum(axis=0), 1, rtol=1e-5)
    np.testing.assert_allclose(policy.entropy(observation), -(np.exp(both) * both).sum(axis=0), rtol=1e-4)
    drawn = policy.sample(jnp.tile(observation[:1], (4000, 1)), jax.random.gumbel(jax.random.key(1), (4000, 2)))
    np.testing.assert_allclose(drawn.mean(axis=0), np.exp(both[:, 0]), atol=0.03)


def test_a_gaussian_has_the_density_of_a_gaussian():
    policy = StochasticPolicy(MLP(3, (16,), 2, key=jax.random.key(0)), jnp.zeros(2))
    observation, action = jnp.ones((1, 3)), jnp.array([[0.3, -1.2]])
    z = np.asarray(action - policy.network(observation))
    want = (-0.5 * z**2 - 0.5 * np.log(2 * np.pi)).sum()
    assert float(policy.log_probability(observation, action)[0]) == pytest.approx(want, rel=1e-5)
    assert float(policy.entropy(observation)[0]) == pytest.approx(2 * 0.5 * np.log(2 * np.pi * np.e), rel=1e-5)


def test_choices_that_there_are_not_have_no_probability():
    policy = choosing(4)
    observation = jnp.asarray(np.random.default_rng(0).normal(size=(500, 3)), jnp.float32)
    available = np.random.default_rng(1).random((500, 4)) < 0.5
    available[:, 0] |= ~available.any(axis=1)
    each = [policy.log_probability(observation, jnp.tile(row, (500, 1)), jnp.asarray(available)) for row in jnp.eye(4)]
    probability = np.exp(np.stack(each, axis=1))
    np.testing.assert_array_equal(probability[~available], 0)
    np.testing.assert_allclose(probability.sum(axis=1), 1, rtol=1e-5)
    some = np.where(available, probability, 1)
    np.testing.assert_allclose(
        policy.entropy(observation, jnp.asarray(available)), -(some * np.log(some)).sum(axis=1), rtol=1e-4, atol=1e-6
    )
    noise = jax.random.gumbel(jax.random.key(2), (500, 4))
    for action in (
        policy.sample(observation, noise, jnp.asarray(available)),
        policy.mode(observation, jnp.asarray(available)),
    ):
        assert available[np.asarray(action, bool)].all()
        np.testing.assert_array_equal(np.asarray(action).sum(axis=1), 1)
    alone = np.eye(4, dtype=bool)[np.arange(500) % 4]
    np.testing.assert_array_equal(policy.entropy(observation, jnp.asarray(alone)), 0)
