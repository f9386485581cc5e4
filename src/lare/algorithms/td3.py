"""TD3: twin delayed deep deterministic policy gradient (Fujimoto, van Hoof and Meger, 2018, algorithm 1).

    a'   = clip(pi'(s') + clip(N(0, policy_noise), -noise_clip, noise_clip), -1, 1)
    y    = r + gamma * continues * min_i Q'_i(s', a')
    Q_i <- descend mean (Q_i(s, a) - y)^2
    pi  <- ascend  mean Q_1(s, pi(s))                       every policy_delay-th update, and then
    Q', pi' <- (1 - tau) (Q', pi') + tau (Q, pi)

The algorithm knows rewards, never where they come from. Actions lie in [-1, 1] in every dimension; whoever talks to the
environment rescales them, so that the paper's noise "times the action bound" is plain noise here.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from pydantic import BaseModel, ConfigDict, Field

from lare.networks import MLP


class TD3Settings(BaseModel):
    """The figures of the TD3 paper; none of them depends on the task."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    learning_rate: float = Field(3e-4, gt=0)
    """Adam's step size, for actor and critics."""
    batch_size: int = Field(256, ge=1)
    """Transitions in one update."""
    gamma: float = Field(0.99, ge=0, le=1)
    """Discount of a step."""
    tau: float = Field(0.005, gt=0, le=1)
    """How far the targets move towards the networks at a policy update."""
    policy_noise: float = Field(0.2, ge=0)
    """Standard deviation of the noise on the target action, in units of the action bound."""
    noise_clip: float = Field(0.5, ge=0)
    """Bound of that noise."""
    policy_delay: int = Field(2, ge=1)
    """Critic updates for each update of actor and targets."""
    exploration_noise: float = Field(0.1, ge=0)
    """Standard deviation of the noise on the actions that are taken, in units of the action bound."""
    warmup: int = Field(10_000, ge=0)
    """Environment steps with uniformly random actions before the first update."""


class Transitions(NamedTuple):
    """A batch of transitions, as an algorithm sees them."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    reward: Float[Array, " batch"]
    next_observation: Float[Array, "batch observation"]
    continues: Float[Array, " batch"]
    """0 where the episode terminated, else 1: the end of the time is not a termination, the bootstrap goes on."""


class Networks(NamedTuple):
    actor: MLP
    critics: MLP
    """Both critics in one pytree, stacked on a leading axis of 2."""


class TD3(NamedTuple):
    """Everything that TD3 learns."""

    online: Networks
    target: Networks
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState


def init(key: PRNGKeyArray, observation_size: int, action_size: int, settings: TD3Settings) -> TD3:
    actor_key, critic_key = jax.random.split(key)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key)

    def critic(key: PRNGKeyArray) -> MLP:
        return MLP(observation_size + action_size, settings.hidden, 1, key=key)

    online = Networks(actor, eqx.filter_vmap(critic)(jax.random.split(critic_key, 2)))
    optimizer = optax.adam(settings.learning_rate)
    # The targets are copies: two names for one buffer could not be donated to the compiled update.
    return TD3(online, jax.tree.map(jnp.copy, online), optimizer.init(online.actor), optimizer.init(online.critics))


def act(actor: MLP, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
    """The deterministic policy, in [-1, 1]."""
    return jnp.tanh(actor(observation))


def value(
    critic: MLP, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
) -> Float[Array, "*batch"]:
    """Q(s, a) by one critic."""
    return critic(jnp.concatenate([observation, action], axis=-1))[..., 0]


def values(
    critics: MLP, observation: Float[Array, "batch observation"], action: Float[Array, "batch action"]
) -> Float[Array, "2 batch"]:
    """Q_1 and Q_2."""
    return jax.vmap(value, (0, None, None))(critics, observation, action)


def target_values(
    target: Networks, batch: Transitions, key: PRNGKeyArray, settings: TD3Settings
) -> Float[Array, " batch"]:
    """y: the smaller of the target critics' values, at the target policy's smoothed action."""
    noise = settings.policy_noise * jax.random.normal(key, batch.action.shape)
    noise = jnp.clip(noise, -settings.noise_clip, settings.noise_clip)
    action = jnp.clip(act(target.actor, batch.next_observation) + noise, -1, 1)
    future = jnp.min(values(target.critics, batch.next_observation, action), axis=0)
    return batch.reward + settings.gamma * batch.continues * future


def update(
    state: TD3, batch: Transitions, key: PRNGKeyArray, update_policy: Bool[Array, ""], settings: TD3Settings
) -> tuple[TD3, dict[str, Float[Array, ""]]]:
    """One critic update, and one of actor and targets where `update_policy` says so.

    `update_policy` is an argument, not a counter in the state, so that under `vmap` over seeds it stays one value for
    all of them and the delayed half is skipped rather than computed and thrown away.
    """
    optimizer = optax.adam(settings.learning_rate)
    target = target_values(state.target, batch, key, settings)

    def critic_loss(critics: MLP) -> Float[Array, ""]:
        return jnp.sum(jnp.mean((values(critics, batch.observation, batch.action) - target) ** 2, axis=1))

    def actor_loss(actor: MLP, critics: MLP) -> Float[Array, ""]:
        first = jax.tree.map(lambda leaf: leaf[0], critics)
        return -jnp.mean(value(first, batch.observation, act(actor, batch.observation)))

    loss, gradient = jax.value_and_grad(critic_loss)(state.online.critics)
    change, critic_optimizer = optimizer.update(gradient, state.critic_optimizer)
    critics = optax.apply_updates(state.online.critics, change)

    def delayed(actor: MLP, target: Networks, actor_optimizer: optax.OptState):
        change, actor_optimizer = optimizer.update(jax.grad(actor_loss)(actor, critics), actor_optimizer)
        online = Networks(optax.apply_updates(actor, change), critics)
        return online.actor, optax.incremental_update(online, target, settings.tau), actor_optimizer

    actor, targets, actor_optimizer = jax.lax.cond(
        update_policy, delayed, lambda *kept: kept, state.online.actor, state.target, state.actor_optimizer
    )
    state = TD3(Networks(actor, critics), targets, actor_optimizer, critic_optimizer)
    return state, {"critic/loss": loss, "critic/value": jnp.mean(target)}
