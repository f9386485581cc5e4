"""Stochastic policies: Gaussian for continuous actions, categorical over the available choices for discrete ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lare_rl.nn.networks import MLP

Available = Bool[Array, "*batch action"] | None
"""Which choices are available. None: all of them, or the actions are continuous."""

UNAVAILABLE = -1e9
"""The logit of an unavailable choice."""


class StochasticPolicy(eqx.Module):
    """A Gaussian whose standard deviation does not depend on the state, or, without one, a choice among the action's entries.

    A choice is a one-hot row, so that every action is a row of numbers. Observations are already normalised, if they are at all.
    """

    network: MLP
    log_deviation: Float[Array, "*stack action"] | None

    def logits(
        self, observation: Float[Array, "*batch observation"], available: Available
    ) -> Float[Array, "*batch action"]:
        """The logit of each choice. That of an unavailable choice is so low that its probability is 0."""
        out = self.network(observation)
        return out if available is None else jnp.where(available, out, UNAVAILABLE)

    def log_probability(
        self,
        observation: Float[Array, "*batch observation"],
        action: Float[Array, "*batch action"],
        available: Available = None,
    ) -> Float[Array, "*batch"]:
        """The log probability of the action, log pi(a | s)."""
        if self.log_deviation is None:
            return jnp.sum(action * jax.nn.log_softmax(self.logits(observation, available)), axis=-1)
        scaled = (action - self.network(observation)) * jnp.exp(-self.log_deviation)
        return jnp.sum(-0.5 * scaled**2 - self.log_deviation - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(
        self, observation: Float[Array, "*batch observation"], available: Available = None
    ) -> Float[Array, "*batch"]:
        """The entropy, -E log pi(a | s)."""
        if self.log_deviation is None:
            log = jax.nn.log_softmax(self.logits(observation, available))
            return -jnp.sum(jnp.exp(log) * log, axis=-1)
        of_one = self.log_deviation + 0.5 * jnp.log(2 * jnp.pi * jnp.e)
        return jnp.broadcast_to(jnp.sum(of_one, axis=-1), observation.shape[:-1])

    def sample(
        self,
        observation: Float[Array, "*batch observation"],
        noise: Float[Array, "*batch action"],
        available: Available = None,
    ) -> Float[Array, "*batch action"]:
        """The action for the given noise: standard normal, or, for choices, Gumbel (the largest logit plus noise is chosen)."""
        if self.log_deviation is None:
            logits = self.logits(observation, available)
            return jax.nn.one_hot(jnp.argmax(logits + noise, axis=-1), logits.shape[-1])
        return self.network(observation) + jnp.exp(self.log_deviation) * noise

    def mode(
        self, observation: Float[Array, "*batch observation"], available: Available = None
    ) -> Float[Array, "*batch action"]:
        """The likeliest action."""
        if self.log_deviation is None:
            logits = self.logits(observation, available)
            return jax.nn.one_hot(jnp.argmax(logits, axis=-1), logits.shape[-1])
        return self.network(observation)
