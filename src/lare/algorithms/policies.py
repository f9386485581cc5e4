"""Policies that draw their actions: from a Gaussian, or from the choices that are available."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lare.networks import MLP

Available = Bool[Array, "*batch action"] | None
"""Which choices there are; all of them, and all continuous actions, where None."""

UNAVAILABLE = -1e9
"""The logit of a choice that there is not."""


class StochasticPolicy(eqx.Module):
    """A Gaussian of constant deviation, or, without one, a choice among the entries of the action.

    A choice is a row with a single 1, so that every action is a row of numbers. Observations are as the network is given them.
    """

    network: MLP
    log_deviation: Float[Array, "*stack action"] | None

    def logits(
        self, observation: Float[Array, "*batch observation"], available: Available
    ) -> Float[Array, "*batch action"]:
        """Of each choice; so low where it is not available that its probability is 0."""
        out = self.network(observation)
        return out if available is None else jnp.where(available, out, UNAVAILABLE)

    def log_probability(
        self,
        observation: Float[Array, "*batch observation"],
        action: Float[Array, "*batch action"],
        available: Available = None,
    ) -> Float[Array, "*batch"]:
        """Of the action: log pi(a | s)."""
        if self.log_deviation is None:
            return jnp.sum(action * jax.nn.log_softmax(self.logits(observation, available)), axis=-1)
        scaled = (action - self.network(observation)) * jnp.exp(-self.log_deviation)
        return jnp.sum(-0.5 * scaled**2 - self.log_deviation - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(
        self, observation: Float[Array, "*batch observation"], available: Available = None
    ) -> Float[Array, "*batch"]:
        """-E log pi(a | s)."""
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
        """The action that noise decides on: standard normal noise, or Gumbel's, whose largest sum is a choice."""
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
