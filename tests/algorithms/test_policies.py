"""Probabilities of stochastic policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.algorithms.ppo.policies import StochasticPolicy
from lare_rl.nn.networks import MLP


def test_gaussian_density():
    policy = StochasticPolicy(MLP(3, (16,), 2, key=jax.random.key(0)), jnp.full(2, 0.3))
    observation, action = jnp.ones((1, 3)), jnp.array([[0.3, -1.2]])
    z = np.asarray(action - policy.network(observation)) / np.exp(0.3)
    expected = (-0.5 * z**2 - 0.3 - 0.5 * np.log(2 * np.pi)).sum()
    assert float(policy.log_probability(observation, action)[0]) == pytest.approx(expected, rel=1e-5)
    entropy = 2 * (0.3 + 0.5 * np.log(2 * np.pi * np.e))
    assert float(policy.entropy(observation)[0]) == pytest.approx(entropy, rel=1e-5)
    noise = jnp.array([[1.0, -2.0]])
    sample = policy.network(observation) + np.exp(0.3) * noise
    np.testing.assert_allclose(policy.sample(observation, noise), sample, rtol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_categorical_probabilities(masked):
    """Unavailable choices have probability 0 and are never chosen."""
    policy = StochasticPolicy(MLP(3, (16,), 4, key=jax.random.key(0)), None)
    rng = np.random.default_rng(0)
    observation, mask = jnp.asarray(rng.normal(size=(500, 3)), jnp.float32), rng.random((500, 4)) < 0.5
    mask[:, 0] |= ~mask.any(axis=1)
    mask[0] = [False, True, False, False]
    mask = mask if masked else np.ones_like(mask)
    available = jnp.asarray(mask) if masked else None
    log_pi = [policy.log_probability(observation, jnp.tile(row, (500, 1)), available) for row in jnp.eye(4)]
    probability = np.exp(np.stack(log_pi, axis=1))
    np.testing.assert_array_equal(probability[~mask], 0)
    np.testing.assert_allclose(probability.sum(axis=1), 1, rtol=1e-5)
    entropy = -(probability * np.log(np.where(mask, probability, 1))).sum(axis=1)
    np.testing.assert_allclose(policy.entropy(observation, available), entropy, rtol=1e-4, atol=1e-6)
    mode = np.asarray(policy.mode(observation, available))
    np.testing.assert_array_equal(mode.argmax(axis=1), probability.argmax(axis=1))
    repeated = jnp.tile(observation[1:2], (4000, 1))
    choices = None if available is None else jnp.tile(available[1:2], (4000, 1))
    samples = policy.sample(repeated, jax.random.gumbel(jax.random.key(1), (4000, 4)), choices)
    np.testing.assert_allclose(samples.mean(axis=0), probability[1], atol=0.03)
    assert mask[1][np.asarray(samples.max(axis=0), bool)].all()
