"""SAC: soft actor-critic with a learned temperature (Haarnoja et al., "Soft actor-critic algorithms and applications", 2018).

    (s, a, r, s') is from the replay;  a' ~ pi(. | s'),  a_new ~ pi(. | s)
    y     = r + gamma * (1 - terminated) * (min_i Q'_i(s', a') - alpha log pi(a' | s'))
    Q_i  <- descend mean (Q_i(s, a) - y)^2                                      Eq. 5, 6
    pi   <- descend mean (alpha log pi(a_new | s) - min_i Q_i(s, a_new))        Eq. 9
    alpha <- descend -alpha mean (log pi(a_new | s) + H),  H = -dim(A)          Eq. 18
    Q'   <- (1 - tau) Q' + tau Q                                        every target_every-th update

The policy is a normal distribution squashed by a tanh, pi = tanh(N(mu(s), sigma(s))), in [-1, 1].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Action, Metrics, Observation, PerStep, Transitions
from lare_rl.algorithms.critics import Critics, bootstrapped_target, fit_critics, init_critics, q_values
from lare_rl.algorithms.sac import SACSettings
from lare_rl.nn.networks import MLP, adam_step, copy_networks, init_adam, polyak_update

__all__ = ["SAC", "Networks", "act", "explore", "get_actor", "init", "sample", "soft_td_targets", "update"]

MIN_LOG_STD, MAX_LOG_STD = -20.0, 2.0


class Networks(NamedTuple):
    actor: MLP
    """From observations to mean and log std of each dimension of the action."""
    critics: Critics
    log_temperature: Float[Array, ""]


class SAC(NamedTuple):
    """Everything that SAC learns."""

    online: Networks
    target: Critics
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    temperature_optimizer: optax.OptState


def init(key: PRNGKeyArray, observation_size: int, action_size: int, settings: SACSettings) -> SAC:
    """Return untrained networks."""
    actor_key, critic_key = jax.random.split(key)
    actor = MLP(observation_size, settings.hidden, 2 * action_size, key=actor_key)
    critics = init_critics(critic_key, observation_size, action_size, settings)
    online = Networks(actor, critics, jnp.log(jnp.float32(settings.temperature)))
    return SAC(
        online=online,
        target=copy_networks(critics),
        actor_optimizer=init_adam(actor, settings.learning_rate),
        critic_optimizer=init_adam(critics, settings.learning_rate),
        temperature_optimizer=init_adam(online.log_temperature, settings.learning_rate),
    )


def get_actor(state: SAC) -> MLP:
    """Return what is needed to act."""
    return state.online.actor


def _mean_and_log_std(actor: MLP, observation: Observation) -> tuple[Action, Action]:
    """Return mean and log std of the policy, before the tanh."""
    mean, log_std = jnp.split(actor(observation), 2, axis=-1)
    return mean, jnp.clip(log_std, MIN_LOG_STD, MAX_LOG_STD)


def act(actor: MLP, observation: Observation) -> Action:
    """Return the deterministic policy's action, tanh(mu(s))."""
    return jnp.tanh(_mean_and_log_std(actor, observation)[0])


def explore(actor: MLP, observation: Observation, noise: Action, settings: SACSettings) -> Action:
    """Return an action sampled from the policy. `noise` is standard normal."""
    mean, log_std = _mean_and_log_std(actor, observation)
    return jnp.tanh(mean + jnp.exp(log_std) * noise)


def sample(actor: MLP, observation: Observation, key: PRNGKeyArray) -> tuple[Action, PerStep]:
    """Return sampled actions and their log pi: the log density of the normal distribution minus log(1 - tanh(u)^2)."""
    mean, log_std = _mean_and_log_std(actor, observation)
    noise = jax.random.normal(key, mean.shape)
    u = mean + jnp.exp(log_std) * noise
    log_density = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    # This form of log(1 - tanh(u)^2) keeps its precision for large u.
    log_slope = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.tanh(u), jnp.sum(log_density - log_slope, axis=-1)


def soft_td_targets(state: SAC, batch: Transitions, key: PRNGKeyArray, settings: SACSettings) -> PerStep:
    """Return y, whose next action is sampled from the online policy."""
    next_action, log_pi = sample(state.online.actor, batch.next_observation, key)
    next_q = jnp.min(q_values(state.target, batch.next_observation, next_action), axis=0)
    soft_value = next_q - jnp.exp(state.online.log_temperature) * log_pi
    return bootstrapped_target(batch, soft_value, settings.gamma)


def update(
    state: SAC, batch: Transitions, key: PRNGKeyArray, update_index: Int[Scalar, ""], settings: SACSettings
) -> tuple[SAC, Metrics]:
    """Update critics, actor and temperature. Every `target_every`-th update also moves the target critics.

    `update_index` counts updates from 0, of all seeds (see `td3.update`).
    """
    learning_rate = settings.learning_rate
    target_key, actor_key = jax.random.split(key)
    alpha = jnp.exp(state.online.log_temperature)

    target_q = soft_td_targets(state, batch, target_key, settings)
    critics, critic_optimizer, loss = fit_critics(
        state.online.critics, batch, target_q, state.critic_optimizer, learning_rate
    )

    def actor_loss(actor: MLP) -> tuple[Float[Array, ""], Float[Array, ""]]:
        action, log_pi = sample(actor, batch.observation, actor_key)
        q = jnp.min(q_values(critics, batch.observation, action), axis=0)
        return jnp.mean(alpha * log_pi - q), jnp.mean(log_pi)

    gradient, log_pi = jax.grad(actor_loss, has_aux=True)(state.online.actor)
    actor, actor_optimizer = adam_step(state.online.actor, gradient, state.actor_optimizer, learning_rate)

    # Raise the temperature if the entropy, -log pi, is below -dim(A); lower it if above.
    gradient = -alpha * (log_pi - batch.action.shape[-1])
    log_temperature, temperature_optimizer = adam_step(
        state.online.log_temperature, gradient, state.temperature_optimizer, learning_rate
    )

    target = jax.lax.cond(
        (update_index + 1) % settings.target_every == 0,
        lambda target: polyak_update(target, critics, settings.tau),
        lambda target: target,
        state.target,
    )
    state = SAC(
        online=Networks(actor, critics, log_temperature),
        target=target,
        actor_optimizer=actor_optimizer,
        critic_optimizer=critic_optimizer,
        temperature_optimizer=temperature_optimizer,
    )
    return state, {
        "critic/loss": loss,
        "critic/value": jnp.mean(target_q),
        "actor/entropy": -log_pi,
        "actor/temperature": alpha,
    }
