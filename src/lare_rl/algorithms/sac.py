"""SAC: soft actor-critic with a learned temperature (Haarnoja et al., "Soft actor-critic algorithms and applications", 2018).

    a', a ~ pi(. | s'), pi(. | s)
    y     = r + gamma * continues * (min_i Q'_i(s', a') - alpha log pi(a' | s'))
    Q_i  <- descend mean (Q_i(s, a_taken) - y)^2                        Eq. 5, 6
    pi   <- descend mean (alpha log pi(a | s) - min_i Q_i(s, a))        Eq. 9
    alpha <- descend -alpha mean (log pi(a | s) + H),  H = -dim(A)      Eq. 18
    Q'   <- (1 - tau) Q' + tau Q                                        every target_every-th update

The policy is a normal distribution squashed by a tanh, pi = tanh(N(mu(s), sigma(s))), in [-1, 1].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.critics import Transitions, critics, squared_errors, values
from lare_rl.algorithms.settings import SACSettings
from lare_rl.nn.networks import MLP, descend, move_towards, start_adam

SMALLEST_LOG, LARGEST_LOG = -20.0, 2.0
"""Bounds of log sigma."""


class Networks(NamedTuple):
    actor: MLP
    """From observations to mu and log sigma of each dimension of the action."""
    critics: MLP
    """All critics in one pytree, stacked on a leading axis."""
    log_temperature: Float[Array, ""]


class SAC(NamedTuple):
    """Everything that SAC learns."""

    online: Networks
    target: MLP
    """The target critics."""
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    temperature_optimizer: optax.OptState


def init(key: PRNGKeyArray, observation_size: int, action_size: int, settings: SACSettings) -> SAC:
    actor_key, critic_key = jax.random.split(key)
    actor = MLP(observation_size, settings.hidden, 2 * action_size, key=actor_key)
    made = critics(critic_key, observation_size, action_size, settings.hidden, settings.critics)
    online = Networks(actor, made, jnp.log(jnp.asarray(settings.temperature)))
    # The targets are copies, because one buffer cannot be donated twice to the compiled update.
    target = jax.tree.map(jnp.copy, made)
    return SAC(online, target, *(start_adam(part, settings.learning_rate) for part in online))


def normal(
    actor: MLP, observation: Float[Array, "*batch observation"]
) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch action"]]:
    """The mean and log sigma of the policy, before the tanh."""
    mean, log_sigma = jnp.split(actor(observation), 2, axis=-1)
    return mean, jnp.clip(log_sigma, SMALLEST_LOG, LARGEST_LOG)


def act(actor: MLP, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
    """The deterministic policy: tanh(mu(s))."""
    return jnp.tanh(normal(actor, observation)[0])


def explore(
    actor: MLP,
    observation: Float[Array, "*batch observation"],
    noise: Float[Array, "*batch action"],
    settings: SACSettings,
) -> Float[Array, "*batch action"]:
    """An action sampled from the policy with standard normal noise."""
    mean, log_sigma = normal(actor, observation)
    return jnp.tanh(mean + jnp.exp(log_sigma) * noise)


def sample(
    actor: MLP, observation: Float[Array, "batch observation"], key: PRNGKeyArray
) -> tuple[Float[Array, "batch action"], Float[Array, " batch"]]:
    """Actions and their log pi: the log of the normal density minus the log slope of the tanh (appendix C, Eq. 21).

    log(1 - tanh(u)^2) is written as 2 (log 2 - u - softplus(-2u)), which keeps its precision for large u.
    """
    mean, log_sigma = normal(actor, observation)
    noise = jax.random.normal(key, mean.shape)
    u = mean + jnp.exp(log_sigma) * noise
    density = -0.5 * noise**2 - log_sigma - 0.5 * jnp.log(2 * jnp.pi)
    slope = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.tanh(u), jnp.sum(density - slope, axis=-1)


def target_values(state: SAC, batch: Transitions, key: PRNGKeyArray, settings: SACSettings) -> Float[Array, " batch"]:
    """y: the reward, plus the discounted smallest target value with its entropy term, at an action sampled from the policy."""
    action, log_pi = sample(state.online.actor, batch.next_observation, key)
    future = jnp.min(values(state.target, batch.next_observation, action), axis=0)
    soft = future - jnp.exp(state.online.log_temperature) * log_pi
    return batch.reward + settings.gamma * batch.continues * soft


def update(
    state: SAC, batch: Transitions, key: PRNGKeyArray, number: Int[Scalar, ""], settings: SACSettings
) -> tuple[SAC, dict[str, Float[Array, ""]]]:
    """One update of critics, actor and temperature. Every `target_every`-th update also moves the target critics.

    `number` counts updates from 0. It is an argument, not part of the state, so that `vmap` over seeds keeps it a single value.
    """
    rate = settings.learning_rate
    target_key, key = jax.random.split(key)
    alpha = jnp.exp(state.online.log_temperature)
    target = target_values(state, batch, target_key, settings)
    loss, gradient = jax.value_and_grad(squared_errors)(state.online.critics, batch, target)
    critics, critic_optimizer = descend(state.online.critics, gradient, state.critic_optimizer, rate)

    def actor_loss(actor: MLP) -> tuple[Float[Array, ""], Float[Array, ""]]:
        action, log_pi = sample(actor, batch.observation, key)
        value = jnp.min(values(critics, batch.observation, action), axis=0)
        return jnp.mean(alpha * log_pi - value), jnp.mean(log_pi)

    gradient, log_pi = jax.grad(actor_loss, has_aux=True)(state.online.actor)
    actor, actor_optimizer = descend(state.online.actor, gradient, state.actor_optimizer, rate)

    slope = -alpha * (log_pi - batch.action.shape[-1])
    log_temperature, temperature_optimizer = descend(
        state.online.log_temperature, slope, state.temperature_optimizer, rate
    )
    moved = (number + 1) % settings.target_every == 0
    targets = jax.lax.cond(
        moved, lambda kept: move_towards(kept, critics, settings.tau), lambda kept: kept, state.target
    )
    online = Networks(actor, critics, log_temperature)
    state = SAC(online, targets, actor_optimizer, critic_optimizer, temperature_optimizer)
    measured = {
        "critic/loss": loss,
        "critic/value": jnp.mean(target),
        "actor/entropy": -log_pi,
        "actor/temperature": alpha,
    }
    return state, measured
