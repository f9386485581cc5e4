"""TD3: twin delayed deep deterministic policy gradient (Fujimoto, van Hoof and Meger, 2018, algorithm 1).

    a'   = clip(pi'(s') + clip(N(0, policy_noise), -noise_clip, noise_clip), -1, 1)
    y    = r + gamma * (1 - terminated) * min_i Q'_i(s', a')
    Q_i <- descend mean (Q_i(s, a) - y)^2
    pi  <- ascend  mean Q_1(s, pi(s))                       every policy_delay-th update, and then
    Q', pi' <- (1 - tau) (Q', pi') + tau (Q, pi)

With one critic, no noise on the target action and no delay, this is DDPG (Lillicrap et al., 2016, algorithm 1), except that
the exploration noise is white here. Actions lie in [-1, 1], so that the paper's noise "times the action bound" is plain noise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Action, Metrics, Observation, PerStep, Transitions
from lare_rl.algorithms.critics import Critics, bootstrapped_target, fit_critics, init_critics, q_value, q_values
from lare_rl.algorithms.td3 import TD3Settings
from lare_rl.nn.networks import MLP, adam_step, copy_networks, init_adam, polyak_update

__all__ = ["TD3", "Networks", "act", "explore", "get_actor", "init", "td_targets", "update"]


class Networks(NamedTuple):
    actor: MLP
    critics: Critics


class TD3(NamedTuple):
    """Everything that TD3 learns."""

    online: Networks
    target: Networks
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState


def init(key: PRNGKeyArray, observation_size: int, action_size: int, settings: TD3Settings) -> TD3:
    """Return untrained networks."""
    actor_key, critic_key = jax.random.split(key)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key)
    critics = init_critics(critic_key, observation_size, action_size, settings)
    online = Networks(actor, critics)
    return TD3(
        online=online,
        target=copy_networks(online),
        actor_optimizer=init_adam(actor, settings.learning_rate),
        critic_optimizer=init_adam(critics, settings.learning_rate),
    )


def get_actor(state: TD3) -> MLP:
    """Return what is needed to act."""
    return state.online.actor


def act(actor: MLP, observation: Observation) -> Action:
    """Return the deterministic policy's action, in [-1, 1]."""
    return jnp.tanh(actor(observation))


def explore(actor: MLP, observation: Observation, noise: Action, settings: TD3Settings) -> Action:
    """Return the policy's action plus scaled exploration noise. `noise` is standard normal."""
    return jnp.clip(act(actor, observation) + settings.exploration_noise * noise, -1, 1)


def td_targets(target: Networks, batch: Transitions, key: PRNGKeyArray, settings: TD3Settings) -> PerStep:
    """Return y, whose next action is that of the target policy with clipped noise."""
    noise = settings.policy_noise * jax.random.normal(key, batch.action.shape)
    noise = jnp.clip(noise, -settings.noise_clip, settings.noise_clip)
    next_action = jnp.clip(act(target.actor, batch.next_observation) + noise, -1, 1)
    next_q = jnp.min(q_values(target.critics, batch.next_observation, next_action), axis=0)
    return bootstrapped_target(batch, next_q, settings.gamma)


def update(
    state: TD3, batch: Transitions, key: PRNGKeyArray, update_index: Int[Scalar, ""], settings: TD3Settings
) -> tuple[TD3, Metrics]:
    """Update the critics. Every `policy_delay`-th update also updates the actor and moves the targets.

    `update_index` counts updates from 0. It is an argument, not part of the state, because all seeds share it: under `vmap`, a
    condition on a batched number would compute the actor's update in every call.
    """
    learning_rate = settings.learning_rate
    target_q = td_targets(state.target, batch, key, settings)
    critics, critic_optimizer, loss = fit_critics(
        state.online.critics, batch, target_q, state.critic_optimizer, learning_rate
    )

    def actor_loss(actor: MLP) -> Float[Array, ""]:
        critic_1 = jax.tree.map(lambda leaf: leaf[0], critics)
        return -jnp.mean(q_value(critic_1, batch.observation, act(actor, batch.observation)))

    def update_actor(actor: MLP, target: Networks, optimizer: optax.OptState) -> tuple[MLP, Networks, optax.OptState]:
        actor, optimizer = adam_step(actor, jax.grad(actor_loss)(actor), optimizer, learning_rate)
        return actor, polyak_update(target, Networks(actor, critics), settings.tau), optimizer

    # The policy is updated less often, so that the critics are accurate when it follows them.
    actor, target, actor_optimizer = jax.lax.cond(
        (update_index + 1) % settings.policy_delay == 0,
        update_actor,
        lambda *unchanged: unchanged,
        state.online.actor,
        state.target,
        state.actor_optimizer,
    )
    state = TD3(
        online=Networks(actor, critics),
        target=target,
        actor_optimizer=actor_optimizer,
        critic_optimizer=critic_optimizer,
    )
    return state, {"critic/loss": loss, "critic/value": jnp.mean(target_q)}
