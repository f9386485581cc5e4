"""Stochastic policies: Gaussian for continuous actions, categorical over the available choices for discrete ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lare_rl.algorithms.batches import Action, Available, Observation, PerStep
from lare_rl.nn.networks import MLP

__all__ = ["StochasticPolicy"]

UNAVAILABLE_LOGIT = -1e9


class StochasticPolicy(eqx.Module):
    """A categorical distribution if `log_std` is None; else a Gaussian, whose standard deviation is the same in all states.

    The caller normalises the observations.
    """

    network: MLP
    log_std: Float[Array, "*stack action"] | None

    def logits(self, observation: Observation, available: Available) -> Action:
        """Return the logit of each choice. That of an unavailable choice is so low that its probability is 0."""
        logits = self.network(observation)
        return logits if available is None else jnp.where(available, logits, UNAVAILABLE_LOGIT)

    def log_probability(self, observation: Observation, action: Action, available: Available = None) -> PerStep:
        """Return log pi(a | s)."""
        if self.log_std is None:
            return jnp.sum(action * jax.nn.log_softmax(self.logits(observation, available)), axis=-1)
        deviation = (action - self.network(observation)) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * deviation**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(self, observation: Observation, available: Available = None) -> PerStep:
        """Return the entropy, -E log pi(a | s)."""
        if self.log_std is None:
            log_pi = jax.nn.log_softmax(self.logits(observation, available))
            return -jnp.sum(jnp.exp(log_pi) * log_pi, axis=-1)
        entropy = self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e)
        return jnp.broadcast_to(jnp.sum(entropy, axis=-1), observation.shape[:-1])

    def sample(self, observation: Observation, noise: Action, available: Available = None) -> Action:
        """Return the action for this noise: standard normal or, for choices, Gumbel.

        The choice with the largest logit + Gumbel noise is a sample from the softmax of the logits. Other actions are not clipped here, but
        when the environment gets them.
        """
        if self.log_std is None:
            return _choose(self.logits(observation, available) + noise)
        return self.network(observation) + jnp.exp(self.log_std) * noise

    def mode(self, observation: Observation, available: Available = None) -> Action:
        """Return the most likely action."""
        if self.log_std is None:
            return _choose(self.logits(observation, available))
        return self.network(observation)


def _choose(logits: Action) -> Action:
    """Return the choice of the largest logit."""
    return jax.nn.one_hot(jnp.argmax(logits, axis=-1), logits.shape[-1])
