"""TD3: twin delayed deep deterministic policy gradient (Fujimoto, van Hoof and Meger, 2018, algorithm 1).

    a'   = clip(pi'(s') + clip(N(0, policy_noise), -noise_clip, noise_clip), -1, 1)
    y    = r + gamma * continues * min_i Q'_i(s', a')
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

from lare_rl.algorithms.critics import Transitions, critics, squared_errors, value, values
from lare_rl.algorithms.settings import TD3Settings
from lare_rl.nn.networks import MLP, descend, move_towards, start_adam


class Networks(NamedTuple):
    actor: MLP
    critics: MLP
    """All critics in one pytree, stacked on a leading axis."""


class TD3(NamedTuple):
    """Everything that TD3 learns."""

    online: Networks
    target: Networks
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState


def init(key: PRNGKeyArray, observation_size: int, action_size: int, settings: TD3Settings) -> TD3:
    actor_key, critic_key = jax.random.split(key)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key)

    online = Networks(actor, critics(critic_key, observation_size, action_size, settings.hidden, settings.critics))
    # The targets are copies, because one buffer cannot be donated twice to the compiled update.
    target = jax.tree.map(jnp.copy, online)
    rate = settings.learning_rate
    return TD3(online, target, start_adam(online.actor, rate), start_adam(online.critics, rate))


def act(actor: MLP, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
    """The deterministic policy, in [-1, 1]."""
    return jnp.tanh(actor(observation))


def explore(
    actor: MLP,
    observation: Float[Array, "*batch observation"],
    noise: Float[Array, "*batch action"],
    settings: TD3Settings,
) -> Float[Array, "*batch action"]:
    """The policy's action plus exploration noise, which is scaled from standard normal noise."""
    return jnp.clip(act(actor, observation) + settings.exploration_noise * noise, -1, 1)


def target_values(
    target: Networks, batch: Transitions, key: PRNGKeyArray, settings: TD3Settings
) -> Float[Array, " batch"]:
    """y: the reward, plus the discounted smallest target value at the target policy's action with clipped noise."""
    noise = settings.policy_noise * jax.random.normal(key, batch.action.shape)
    noise = jnp.clip(noise, -settings.noise_clip, settings.noise_clip)
    action = jnp.clip(act(target.actor, batch.next_observation) + noise, -1, 1)
    future = jnp.min(values(target.critics, batch.next_observation, action), axis=0)
    return batch.reward + settings.gamma * batch.continues * future


def update(
    state: TD3, batch: Transitions, key: PRNGKeyArray, number: Int[Scalar, ""], settings: TD3Settings
) -> tuple[TD3, dict[str, Float[Array, ""]]]:
    """One update of the critics. Every `policy_delay`-th update also updates the actor and moves the targets.

    `number` counts updates from 0. It is an argument, not part of the state, so that `vmap` over seeds keeps it a single value
    and skips the delayed half instead of computing it and throwing it away.
    """
    rate = settings.learning_rate
    target = target_values(state.target, batch, key, settings)

    def actor_loss(actor: MLP, critics: MLP) -> Float[Array, ""]:
        first = jax.tree.map(lambda leaf: leaf[0], critics)
        return -jnp.mean(value(first, batch.observation, act(actor, batch.observation)))

    loss, gradient = jax.value_and_grad(squared_errors)(state.online.critics, batch, target)
    critics, critic_optimizer = descend(state.online.critics, gradient, state.critic_optimizer, rate)

    def delayed(actor: MLP, target: Networks, actor_optimizer: optax.OptState):
        actor, actor_optimizer = descend(actor, jax.grad(actor_loss)(actor, critics), actor_optimizer, rate)
        return actor, move_towards(target, Networks(actor, critics), settings.tau), actor_optimizer

    actor, targets, actor_optimizer = jax.lax.cond(
        (number + 1) % settings.policy_delay == 0,
        delayed,
        lambda *kept: kept,
        state.online.actor,
        state.target,
        state.actor_optimizer,
    )
    state = TD3(Networks(actor, critics), targets, actor_optimizer, critic_optimizer)
    return state, {"critic/loss": loss, "critic/value": jnp.mean(target)}
