"""Critics Q(s, a), which TD3, DDPG and SAC share. Several critics are one pytree, stacked on a leading axis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.algorithms.batches import Action, Observation, Transitions, Value
from lare_rl.nn.networks import MLP, adam_step

__all__ = ["critic_loss", "fit_critics", "init_critics", "q_value", "q_values", "td_target"]


def init_critics(
    key: PRNGKeyArray, observation_size: int, action_size: int, hidden: tuple[int, ...], n_critics: int
) -> MLP:
    """Return untrained critics."""
    make_critic = eqx.filter_vmap(lambda key: MLP(observation_size + action_size, hidden, 1, key=key))
    return make_critic(jax.random.split(key, n_critics))


def q_value(critic: MLP, observation: Observation, action: Action) -> Value:
    """Return Q(s, a) by one critic."""
    return critic(jnp.concatenate([observation, action], axis=-1))[..., 0]


def q_values(critics: MLP, observation: Observation, action: Action) -> Float[Array, "critics *batch"]:
    """Return Q_i(s, a) by each critic."""
    return jax.vmap(q_value, (0, None, None))(critics, observation, action)


def td_target(batch: Transitions, next_value: Float[Array, " batch"], gamma: float) -> Float[Array, " batch"]:
    """Return y = r + gamma (1 - terminated) V(s')."""
    return batch.reward + gamma * (1 - batch.terminated) * next_value


def fit_critics(
    critics: MLP, batch: Transitions, target_q: Float[Array, " batch"], optimizer: optax.OptState, rate: float
) -> tuple[MLP, optax.OptState, Float[Array, ""]]:
    """Fit all critics to one target by a step of Adam. Return them, the optimizer's state and the loss."""
    loss, gradient = jax.value_and_grad(critic_loss)(critics, batch, target_q)
    critics, optimizer = adam_step(critics, gradient, optimizer, rate)
    return critics, optimizer, loss


def critic_loss(critics: MLP, batch: Transitions, target_q: Float[Array, " batch"]) -> Float[Array, ""]:
    """Return the sum over the critics of mean (Q_i(s, a) - y)^2."""
    return jnp.sum(jnp.mean((q_values(critics, batch.observation, batch.action) - target_q) ** 2, axis=1))
