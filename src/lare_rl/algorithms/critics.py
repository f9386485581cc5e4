"""Shared by the algorithms that learn from a replay: the transitions that they read, and critics Q(s, a).

Actions lie in [-1, 1] in every dimension; the code that steps the environment rescales them.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.nn.networks import MLP


class Transitions(NamedTuple):
    """A batch of transitions, as an algorithm sees them."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    reward: Float[Array, " batch"]
    next_observation: Float[Array, "batch observation"]
    continues: Float[Array, " batch"]
    """0 where the episode terminated, else 1. A time limit is not a termination: the target still bootstraps there."""


def critics(key: PRNGKeyArray, observation_size: int, action_size: int, hidden: tuple[int, ...], count: int) -> MLP:
    """Untrained critics in one pytree, stacked on a leading axis."""

    def one(key: PRNGKeyArray) -> MLP:
        return MLP(observation_size + action_size, hidden, 1, key=key)

    return eqx.filter_vmap(one)(jax.random.split(key, count))


def value(
    critic: MLP, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
) -> Float[Array, "*batch"]:
    """Q(s, a) by one critic."""
    return critic(jnp.concatenate([observation, action], axis=-1))[..., 0]


def values(
    critics: MLP, observation: Float[Array, "batch observation"], action: Float[Array, "batch action"]
) -> Float[Array, "critics batch"]:
    """Q_i(s, a) by each critic."""
    return jax.vmap(value, (0, None, None))(critics, observation, action)


def squared_errors(critics: MLP, batch: Transitions, target: Float[Array, " batch"]) -> Float[Array, ""]:
    """The sum over the critics of mean (Q_i(s, a) - y)^2."""
    return jnp.sum(jnp.mean((values(critics, batch.observation, batch.action) - target) ** 2, axis=1))
