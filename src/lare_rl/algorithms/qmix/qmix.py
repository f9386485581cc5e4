"""QMIX: monotonic value function factorisation (Rashid et al., 2018), as in PyMARL2 (Hu et al., 2021), and VDN.

    a*_t    = each agent's available action with the largest Q_i(h_t, .)                by the online networks
    V_t     = Q'_tot(s_t, a*_t)                                                         by the target networks
    G_{t-1} = r_t + gamma * (1 - done_t) * ((1 - lambda) V_t + lambda G_t)
    theta  <- descend  sum mask (Q_tot(s_{t-1}, a_{t-1}) - G_{t-1})^2 / 2 / sum mask
    theta' <- theta                                                                     every target_every-th episode

Each agent acts on its own observations; only training uses the global state s. The team has one reward. VDN (Sunehag et al.,
2018) has a sum instead of the mixer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Metrics, Sequences
from lare_rl.algorithms.qmix import QMIXSettings
from lare_rl.algorithms.qmix.networks import Mixer, RecurrentNetwork, mix
from lare_rl.nn.masks import masked_mean, select
from lare_rl.nn.networks import adam_step, clip_gradient, copy_networks, init_adam

__all__ = ["QMIX", "Memory", "act", "epsilon", "get_actor", "init", "init_memory", "update"]

Observations = Float[Array, "*batch agents observation"]
Actions = Float[Array, "*batch agents action"]
AvailableActions = Bool[Array, "*batch agents action"]
Steps = Float[Array, "episodes steps"]


class Networks(NamedTuple):
    agent: RecurrentNetwork
    mixer: Mixer | None
    """None: the values are summed."""


class QMIX(NamedTuple):
    """Everything that QMIX learns."""

    online: Networks
    target: Networks
    optimizer: optax.OptState


class Memory(NamedTuple):
    """The agents' hidden states and last actions."""

    hidden: Float[Array, "*batch agents hidden"]
    last_action: Actions


def init(
    key: PRNGKeyArray, n_agents: int, observation_size: int, action_size: int, state_size: int, settings: QMIXSettings
) -> QMIX:
    """Return untrained networks."""
    agent_key, mixer_key = jax.random.split(key)
    agent = RecurrentNetwork(observation_size + action_size + n_agents, settings.hidden, action_size, key=agent_key)
    mixer = None
    if settings.monotonic:
        mixer = Mixer(n_agents, state_size, settings.embed, settings.hypernet, key=mixer_key)

    online = Networks(agent, mixer)
    return QMIX(online, copy_networks(online), init_adam(online, settings.learning_rate))


def get_actor(state: QMIX) -> RecurrentNetwork:
    """Return what is needed to act."""
    return state.online.agent


def init_memory(shape: tuple[int, ...], action_size: int, settings: QMIXSettings) -> Memory:
    """Return the memory at the start of an episode. `shape` is the shape of the batch, then the number of agents."""
    return Memory(jnp.zeros((*shape, settings.hidden)), jnp.zeros((*shape, action_size)))


def epsilon(step: Int[Scalar, ""] | int, settings: QMIXSettings) -> Float[Array, ""]:
    """Return the probability that an agent explores after `step` environment steps."""
    fraction = jnp.minimum(step / settings.epsilon_steps, 1)
    return settings.epsilon_start + (settings.epsilon_end - settings.epsilon_start) * fraction


def agent_input(observation: Observations, last_action: Actions) -> Float[Array, "*batch agents in"]:
    """Return the network's input for each agent: its observation, its last action (zeros at first) and its one-hot index."""
    n_agents = observation.shape[-2]
    agent_id = jnp.broadcast_to(jnp.eye(n_agents), (*observation.shape[:-1], n_agents))
    return jnp.concatenate([observation, last_action, agent_id], axis=-1)


def greedy_action(value: Float[Array, "*batch agents action"], available: AvailableActions) -> Actions:
    """Return the available action of largest value; the first action if none is available, as in the padding of an episode."""
    return jax.nn.one_hot(jnp.argmax(jnp.where(available, value, -jnp.inf), axis=-1), value.shape[-1])


def act(
    agent: RecurrentNetwork,
    memory: Memory,
    observation: Observations,
    available: AvailableActions,
    noise: Float[Array, "*batch agents 1+action"] | None = None,
    epsilon: Float[Scalar, ""] | float = 0.0,
) -> tuple[Actions, Memory]:
    """Return the agents' actions, and their new memory.

    Without noise, each agent takes its available action of largest value. Noise is uniform in [0, 1). An agent whose first number
    is below `epsilon` explores: it takes the available action with the largest of the other numbers.
    """
    value, hidden = agent(agent_input(observation, memory.last_action), memory.hidden)
    action = greedy_action(value, available)
    if noise is not None:
        action = jnp.where(noise[..., :1] < epsilon, greedy_action(noise[..., 1:], available), action)
    return action, Memory(hidden, action)


def action_values(agent: RecurrentNetwork, batch: Sequences) -> Float[Array, "episodes times agents action"]:
    """Return Q_i(h_t, .) of every agent at every observation."""
    last_action = jnp.pad(batch.action, ((0, 0), (1, 0), (0, 0), (0, 0)))
    time_major = jnp.swapaxes(agent_input(batch.observation, last_action), 0, 1)
    return jnp.swapaxes(agent.unroll(time_major), 0, 1)


def lambda_returns(
    reward: Steps, done: Steps, mask: Steps, value: Float[Array, "episodes steps+1"], settings: QMIXSettings
) -> Steps:
    """Return G, computed backwards from the end of the padding, where it is 0 (PyMARL2's `build_td_lambda_targets`)."""
    gamma, lambda_ = settings.gamma, settings.td_lambda
    one_step = mask * (reward + (1 - lambda_) * gamma * (1 - done) * value[:, 1:])
    decay = lambda_ * gamma

    def step(next_return: Float[Array, " episodes"], one_step: Float[Array, " episodes"]):
        return_ = one_step + decay * next_return
        return return_, return_

    return jax.lax.scan(step, jnp.zeros(len(reward)), one_step.T, reverse=True)[1].T


def td_targets(
    target: Networks,
    online_value: Float[Array, "episodes times agents action"],
    batch: Sequences,
    settings: QMIXSettings,
) -> Steps:
    """Return G: the online networks choose the actions, and the target networks evaluate them (van Hasselt et al., 2016)."""
    action = greedy_action(online_value, batch.available)
    value = mix(target.mixer, jnp.sum(action * action_values(target.agent, batch), axis=-1), batch.state)
    return lambda_returns(batch.reward, batch.done, batch.mask, value, settings)


def loss(
    online: Networks, target: Networks, batch: Sequences, settings: QMIXSettings
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return half the mean squared error of Q_tot, and the mean of its targets."""
    value = action_values(online.agent, batch)
    target_q = td_targets(target, value, batch, settings)  # no gradient: the online values only choose actions
    q_total = mix(online.mixer, jnp.sum(value[:, :-1] * batch.action, axis=-1), batch.state[:, :-1])
    return masked_mean((q_total - target_q) ** 2, batch.mask) / 2, masked_mean(target_q, batch.mask)


def update(
    state: QMIX, batch: Sequences, copy_target: Bool[Scalar, ""], settings: QMIXSettings
) -> tuple[QMIX, Metrics]:
    """Take one gradient step on whole episodes. If `copy_target`, the target networks then become copies of the online ones."""
    loss_and_gradient = jax.value_and_grad(loss, has_aux=True)
    (td_loss, mean_target), gradient = loss_and_gradient(state.online, state.target, batch, settings)
    gradient = clip_gradient(gradient, settings.max_grad_norm)
    online, optimizer = adam_step(state.online, gradient, state.optimizer, settings.learning_rate)

    # Not a `cond`: seeds are batched by `vmap`, and each seed copies at its own time.
    target = select(copy_target, online, state.target)
    return QMIX(online, target, optimizer), {"critic/loss": td_loss, "critic/value": mean_target}
