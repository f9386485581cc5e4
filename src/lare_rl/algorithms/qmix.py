"""QMIX: monotonic value function factorisation (Rashid et al., 2018), as in PyMARL2 (Hu et al., 2021), and VDN.

    a*_t   = the available actions of largest Q_i(h_t, .)                              by the online networks
    V_t    = Q'_tot(s_t, a*_t)                                                         by the target networks
    G_t    = r_t + gamma * (1 - terminated_t) * ((1 - lambda) V_{t+1} + lambda G_{t+1})
    theta <- descend  sum mask (Q_tot(s_t, a_t) - G_t)^2 / 2 / sum mask
    theta' <- theta                                                                    every target_every-th episode

Each agent acts on its own observations; only training uses the global state s. The team has one reward. VDN (Sunehag et al.,
2018) has a sum instead of the mixer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.mixer import Mixer, mixed
from lare_rl.algorithms.settings import QMIXSettings
from lare_rl.nn.networks import clipped, descend, start_adam
from lare_rl.nn.recurrent import Recurrent


class Networks(NamedTuple):
    agent: Recurrent
    mixer: Mixer | None
    """None: the values are summed."""


class QMIX(NamedTuple):
    """Everything that QMIX learns."""

    online: Networks
    target: Networks
    optimizer: optax.OptState


class Sequences(NamedTuple):
    """Whole episodes, padded to one length. The padding is ignored, but `terminated` and `mask` must be 0 there."""

    observation: Float[Array, "episodes steps+1 agents observation"]
    state: Float[Array, "episodes steps+1 state"]
    available: Bool[Array, "episodes steps+1 agents action"]
    action: Float[Array, "episodes steps agents action"]
    """One-hot rows."""
    reward: Float[Array, "episodes steps"]
    """The team's reward."""
    terminated: Float[Array, "episodes steps"]
    """1 at the last step of an episode, even if a time limit ended it."""
    mask: Float[Array, "episodes steps"]
    """1 on the steps that were taken."""


class Memory(NamedTuple):
    """What the agents remember from one step to the next."""

    hidden: Float[Array, "*batch agents hidden"]
    last_action: Float[Array, "*batch agents action"]


def init(
    key: PRNGKeyArray, agents: int, observation_size: int, action_size: int, state_size: int, settings: QMIXSettings
) -> QMIX:
    agent_key, mixer_key = jax.random.split(key)
    agent = Recurrent(observation_size + action_size + agents, settings.hidden, action_size, key=agent_key)
    mixer = None
    if settings.monotonic:
        mixer = Mixer(agents, state_size, settings.embed, settings.hypernet, key=mixer_key)

    online = Networks(agent, mixer)
    # The targets are copies, because one buffer cannot be donated twice to the compiled update.
    return QMIX(online, jax.tree.map(jnp.copy, online), start_adam(online, settings.learning_rate))


def no_memory(shape: tuple[int, ...], action_size: int, settings: QMIXSettings) -> Memory:
    """The memory at the start of an episode; `shape` is the shape of the batch, then the number of agents."""
    return Memory(jnp.zeros((*shape, settings.hidden)), jnp.zeros((*shape, action_size)))


def epsilon(done: Int[Scalar, ""] | int, settings: QMIXSettings) -> Float[Array, ""]:
    """The probability that an agent explores after `done` environment steps."""
    share = jnp.minimum(done / settings.epsilon_steps, 1)
    return settings.epsilon_start + (settings.epsilon_end - settings.epsilon_start) * share


def known(
    observation: Float[Array, "*batch agents observation"], last_action: Float[Array, "*batch agents action"]
) -> Float[Array, "*batch agents in"]:
    """The network's input for each agent: its observation, its last action (zeros at first) and its one-hot index."""
    agents = observation.shape[-2]
    which = jnp.broadcast_to(jnp.eye(agents), (*observation.shape[:-1], agents))
    return jnp.concatenate([observation, last_action, which], axis=-1)


def best(
    value: Float[Array, "*batch agents action"], available: Bool[Array, "*batch agents action"]
) -> Float[Array, "*batch agents action"]:
    """The available action of largest value; the first action if none is available, as in the padding of an episode."""
    return jax.nn.one_hot(jnp.argmax(jnp.where(available, value, -jnp.inf), axis=-1), value.shape[-1])


def act(
    agent: Recurrent,
    memory: Memory,
    observation: Float[Array, "*batch agents observation"],
    available: Bool[Array, "*batch agents action"],
    noise: Float[Array, "*batch agents 1+action"] | None = None,
    epsilon: Float[Scalar, ""] | float = 0.0,
) -> tuple[Float[Array, "*batch agents action"], Memory]:
    """The agents' actions, and their new memory.

    Without noise, each agent takes the best of its available actions. Noise is uniform in [0, 1): an agent whose first number
    is below `epsilon` explores, which means that it takes the available action whose number is the largest.
    """
    value, hidden = agent(known(observation, memory.last_action), memory.hidden)
    action = best(value, available)
    if noise is not None:
        action = jnp.where(noise[..., :1] < epsilon, best(noise[..., 1:], available), action)
    return action, Memory(hidden, action)


def action_values(agent: Recurrent, batch: Sequences) -> Float[Array, "episodes times agents action"]:
    """Q_i(h_t, .) of every agent, at every observation (one more than there are steps)."""
    last_action = jnp.pad(batch.action, ((0, 0), (1, 0), (0, 0), (0, 0)))
    by_time = jnp.swapaxes(known(batch.observation, last_action), 0, 1)
    return jnp.swapaxes(agent.unroll(by_time), 0, 1)


def lambda_returns(
    reward: Float[Array, "episodes steps"],
    terminated: Float[Array, "episodes steps"],
    mask: Float[Array, "episodes steps"],
    value: Float[Array, "episodes steps+1"],
    settings: QMIXSettings,
) -> Float[Array, "episodes steps"]:
    """G, backwards from the end of the padding (PyMARL2's `build_td_lambda_targets`).

    After the last step of an episode G is 0: the rewards are masked there, and `terminated` removes the final value.
    """
    kept = settings.td_lambda * settings.gamma
    at_once = mask * (reward + (1 - settings.td_lambda) * settings.gamma * (1 - terminated) * value[:, 1:])

    def back(later: Float[Array, " episodes"], now: Float[Array, " episodes"]):
        target = now + kept * later
        return target, target

    end = value[:, -1] * (1 - jnp.sum(terminated, axis=1))
    return jax.lax.scan(back, end, at_once.T, reverse=True)[1].T


def targets(
    target: Networks,
    online: Float[Array, "episodes times agents action"],
    batch: Sequences,
    settings: QMIXSettings,
) -> Float[Array, "episodes steps"]:
    """G: the online networks choose the actions, and the target networks evaluate them (van Hasselt et al., 2016)."""
    taken = jnp.sum(best(online, batch.available) * action_values(target.agent, batch), axis=-1)
    value = mixed(target.mixer, taken, batch.state)
    return lambda_returns(batch.reward, batch.terminated, batch.mask, value, settings)


def mean(x: Float[Array, "episodes steps"], mask: Float[Array, "episodes steps"]) -> Float[Array, ""]:
    """The mean over the steps that were taken; 0 if there are none."""
    return jnp.sum(mask * x) / jnp.maximum(jnp.sum(mask), 1)


def loss(
    online: Networks, target: Networks, batch: Sequences, settings: QMIXSettings
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Half the mean squared error of Q_tot, and the mean of its targets."""
    value = action_values(online.agent, batch)
    wanted = targets(target, value, batch, settings)  # without gradient: the online values only choose actions
    taken = jnp.sum(value[:, :-1] * batch.action, axis=-1)
    total = mixed(online.mixer, taken, batch.state[:, :-1])
    return mean((total - wanted) ** 2, batch.mask) / 2, mean(wanted, batch.mask)


def update(
    state: QMIX, batch: Sequences, targets_move: Bool[Scalar, ""], settings: QMIXSettings
) -> tuple[QMIX, dict[str, Float[Array, ""]]]:
    """One gradient step on whole episodes. If `targets_move`, the target networks then become copies of the online ones."""
    of_loss = jax.value_and_grad(loss, has_aux=True)
    (missed, wanted), gradient = of_loss(state.online, state.target, batch, settings)
    gradient = clipped(gradient, settings.max_grad_norm)
    online, optimizer = descend(state.online, gradient, state.optimizer, settings.learning_rate)
    target = jax.tree.map(lambda old, new: jnp.where(targets_move, new, old), state.target, online)
    return QMIX(online, target, optimizer), {"critic/loss": missed, "critic/value": wanted}
