"""The critics Q_i(s, a) of TD3, DDPG and SAC."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.algorithms.batches import Action, Observation, PerStep, Transitions
from lare_rl.algorithms.off_policy import OffPolicySettings
from lare_rl.nn.networks import MLP, adam_step

__all__ = ["Critics", "bootstrapped_target", "fit_critics", "init_critics", "q_value", "q_values"]

Critics = MLP
"""All critics in one pytree, stacked on a leading axis."""


def init_critics(key: PRNGKeyArray, observation_size: int, action_size: int, settings: OffPolicySettings) -> Critics:
    """Return untrained critics."""
    make_critic = eqx.filter_vmap(lambda key: MLP(observation_size + action_size, settings.hidden, 1, key=key))
    return make_critic(jax.random.split(key, settings.critics))


def q_value(critic: MLP, observation: Observation, action: Action) -> PerStep:
    """Return Q(s, a) by one critic."""
    return critic(jnp.concatenate([observation, action], axis=-1))[..., 0]


def q_values(critics: Critics, observation: Observation, action: Action) -> Float[Array, "critics *batch"]:
    """Return Q_i(s, a) by each critic."""
    return jax.vmap(q_value, (0, None, None))(critics, observation, action)


def bootstrapped_target(batch: Transitions, next_value: PerStep, gamma: float) -> PerStep:
    """Return the target y = r + gamma (1 - terminated) V(s')."""
    return batch.reward + gamma * (1 - batch.terminated) * next_value


def fit_critics(
    critics: Critics, batch: Transitions, target_q: PerStep, optimizer: optax.OptState, learning_rate: float
) -> tuple[Critics, optax.OptState, Float[Array, ""]]:
    """Take a step of Adam on all critics. Return them, the optimizer's state and the loss: the sum over i of mean (Q_i(s, a) - y)^2."""

    def loss(critics: Critics) -> Float[Array, ""]:
        return jnp.sum(jnp.mean((q_values(critics, batch.observation, batch.action) - target_q) ** 2, axis=1))

    loss_before, gradient = jax.value_and_grad(loss)(critics)
    return *adam_step(critics, gradient, optimizer, learning_rate), loss_before
