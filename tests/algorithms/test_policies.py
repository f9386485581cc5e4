import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lare_rl.algorithms.ppo.policies import StochasticPolicy
from lare_rl.nn.networks import MLP

METHODS = ("log_probability", "entropy", "sample", "mode")
log_probability, entropy, sample, mode = (eqx.filter_jit(getattr(StochasticPolicy, name)) for name in METHODS)


def test_gaussian_density():
    policy = StochasticPolicy(MLP(3, (16,), 2, key=jax.random.key(0)), jnp.full(2, 0.3))
    observation, action = jnp.ones((1, 3)), jnp.array([[0.3, -1.2]])
    mean = np.asarray(policy.network(observation))
    z = (np.asarray(action) - mean) / np.exp(0.3)
    expected = (-0.5 * z**2 - 0.3 - 0.5 * np.log(2 * np.pi)).sum()
    assert float(log_probability(policy, observation, action)[0]) == pytest.approx(expected, rel=1e-5)
    expected = 2 * (0.3 + 0.5 * np.log(2 * np.pi * np.e))
    assert float(entropy(policy, observation)[0]) == pytest.approx(expected, rel=1e-5)
    noise = np.float32([[1, -2]])
    np.testing.assert_allclose(sample(policy, observation, noise), mean + np.exp(0.3) * noise, rtol=1e-5)
    np.testing.assert_allclose(mode(policy, observation), mean, rtol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_categorical_probabilities(masked):
    """Unavailable choices have probability 0 and are never chosen."""
    policy = StochasticPolicy(MLP(3, (16,), 4, key=jax.random.key(0)), None)
    rng = np.random.default_rng(0)
    observation, mask = rng.normal(size=(500, 3)).astype(np.float32), rng.random((500, 4)) < 0.5
    mask[:, 0] |= ~mask.any(axis=1)
    mask[0] = [False, True, False, False]
    mask = mask if masked else np.ones_like(mask)
    available = mask if masked else None
    choices = np.tile(np.eye(4, dtype=np.float32)[:, None], (500, 1))
    probability = np.exp(np.stack([log_probability(policy, observation, rows, available) for rows in choices], axis=1))
    np.testing.assert_array_equal(probability[~mask], 0)
    np.testing.assert_allclose(probability.sum(axis=1), 1, rtol=1e-5)
    expected = -(probability * np.log(np.where(mask, probability, 1))).sum(axis=1)
    np.testing.assert_allclose(entropy(policy, observation, available), expected, rtol=1e-4, atol=1e-6)
    likeliest = np.asarray(mode(policy, observation, available)).argmax(axis=1)
    np.testing.assert_array_equal(likeliest, probability.argmax(axis=1))
    repeated = np.tile(observation[1], (4000, 1))
    noise, available = rng.gumbel(size=(4000, 4)).astype(np.float32), np.tile(mask[1], (4000, 1)) if masked else None
    samples = np.asarray(sample(policy, repeated, noise, available))
    np.testing.assert_allclose(samples.mean(axis=0), probability[1], atol=0.03)
    assert mask[1][samples.max(axis=0) > 0].all()
