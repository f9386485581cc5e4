"""PPO: proximal policy optimisation (Schulman et al., 2017), and IPPO, which is the same update for many agents at once.

    delta_t = r_t + gamma * continues_t * V(s'_t) - V(s_t)
    A_t     = delta_t + gamma * lambda * (1 - ended_t) * A_{t+1}          (Schulman et al., 2016)
    rho     = pi(a | s) / pi_old(a | s)
    theta  <- ascend  mean min(rho A, clip(rho, 1 - c, 1 + c) A)  -  v * value loss  +  e * entropy

Independent PPO (de Witt et al., 2020) lets all agents share one actor and one critic, each judging by what it observes
itself: to this file an agent is one more lane of the rollout. The algorithm knows rewards, never where they come from.

The critic predicts returns in units of their running mean and deviation (Yu et al., 2022), and advantages are normalised
over the rollout, so rewards of any scale train alike.
"""

from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, Scalar
from pydantic import Field

from lare.errors import Checked
from lare.networks import MLP, descend, orthogonal, start_adam
from lare.normalise import Moments, deviation, no_moments, observe


class PPOSettings(Checked):
    """Hyperparameters of PPO; what `lare train` uses where nothing is said stands in `table.py`."""

    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    learning_rate: Annotated[float, Field(gt=0)] = 3e-4
    """Adam's step size, for actor and critic."""
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.99
    """Discount of a step."""
    gae_lambda: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Of the generalised advantage estimates: 0 trusts the critic, 1 the rewards."""
    epochs: Annotated[int, Field(ge=1)] = 10
    """How often an update goes over its rollout."""
    minibatch_size: Annotated[int, Field(ge=1)] = 64
    """Steps of one agent in one gradient step."""
    clip: Annotated[float, Field(gt=0)] = 0.2
    """How far the probability ratio may move."""
    value_clip: Annotated[float, Field(gt=0)] = 0.5
    """How far the value may move in one update, in deviations of the return."""
    value_coef: Annotated[float, Field(ge=0)] = 0.5
    """Of the value loss beside the policy's."""
    entropy_coef: Annotated[float, Field(ge=0)] = 0.0
    """Of the policy's entropy beside its objective."""
    huber_delta: Annotated[float, Field(gt=0)] = 10.0
    """Where the value loss turns from square to linear, in deviations of the return."""
    max_grad_norm: Annotated[float, Field(gt=0)] = 0.5
    """What the gradient of actor and critic together is cut down to."""
    anneal: bool = False
    """Let learning rate and clip fall linearly to 0 over the run."""


class Policy(eqx.Module):
    """A Gaussian of constant deviation, or, without one, a choice among the entries of the action.

    A choice is a row with a single 1, so that every action is a row of numbers.
    """

    network: MLP
    log_deviation: Float[Array, "*stack action"] | None

    def log_probability(
        self, observation: Float[Array, "*batch observation"], action: Float[Array, "*batch action"]
    ) -> Float[Array, "*batch"]:
        """Of the action: log pi(a | s)."""
        out = self.network(observation)
        if self.log_deviation is None:
            return jnp.sum(action * jax.nn.log_softmax(out), axis=-1)
        scaled = (action - out) * jnp.exp(-self.log_deviation)
        return jnp.sum(-0.5 * scaled**2 - self.log_deviation - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch"]:
        """-E log pi(a | s)."""
        if self.log_deviation is None:
            log = jax.nn.log_softmax(self.network(observation))
            return -jnp.sum(jnp.exp(log) * log, axis=-1)
        of_one = self.log_deviation + 0.5 * jnp.log(2 * jnp.pi * jnp.e)
        return jnp.broadcast_to(jnp.sum(of_one, axis=-1), observation.shape[:-1])

    def sample(
        self, observation: Float[Array, "*batch observation"], key: PRNGKeyArray
    ) -> Float[Array, "*batch action"]:
        """Draw a ~ pi(. | s)."""
        draw = jax.random.gumbel if self.log_deviation is None else jax.random.normal
        size = self.network.layers[-1].bias.shape[-1]
        return self.drawn(observation, draw(key, (*observation.shape[:-1], size)))

    def drawn(
        self, observation: Float[Array, "*batch observation"], noise: Float[Array, "*batch action"]
    ) -> Float[Array, "*batch action"]:
        """The action that noise decides on: standard normal noise, or Gumbel's, whose largest sum is a choice."""
        out = self.network(observation)
        if self.log_deviation is None:
            return jax.nn.one_hot(jnp.argmax(out + noise, axis=-1), out.shape[-1])
        return out + jnp.exp(self.log_deviation) * noise

    def mode(self, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch action"]:
        """The likeliest action."""
        out = self.network(observation)
        return jax.nn.one_hot(jnp.argmax(out, axis=-1), out.shape[-1]) if self.log_deviation is None else out


class Networks(NamedTuple):
    actor: Policy
    critic: MLP


class PPO(NamedTuple):
    """Everything that PPO learns."""

    online: Networks
    optimizer: optax.OptState
    returns: Moments
    """Of the returns that the critic was fitted to."""


class Rollout(NamedTuple):
    """What the newest policy met. A lane is one agent in one environment."""

    observation: Float[Array, "time lanes observation"]
    action: Float[Array, "time lanes action"]
    reward: Float[Array, "time lanes"]
    next_observation: Float[Array, "time lanes observation"]
    continues: Float[Array, "time lanes"]
    """0 where the episode terminated, else 1: the bootstrap goes on."""
    ended: Float[Array, "time lanes"]
    """1 at the last step of an episode, terminated or out of time."""


class Minibatch(NamedTuple):
    """Steps of agents, and what is to be learned from them."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    log_probability: Float[Array, " batch"]
    """Of the action, by the policy that took it."""
    advantage: Float[Array, " batch"]
    value: Float[Array, " batch"]
    """What the critic said before the update, as it said it: that is what may move by no more than `value_clip`."""
    target: Float[Array, " batch"]
    """In deviations of the return, the newest included."""


def init(key: PRNGKeyArray, observation_size: int, action_size: int, discrete: bool, settings: PPOSettings) -> PPO:
    """Orthogonal weights, a policy that hardly prefers anything yet, values near 0."""
    actor_key, critic_key, *keys = jax.random.split(key, 4)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key, activation=jnp.tanh)
    critic = MLP(observation_size, settings.hidden, 1, key=critic_key, activation=jnp.tanh)
    policy = Policy(orthogonal(actor, 0.01, key=keys[0]), None if discrete else jnp.zeros(action_size))
    online = Networks(policy, orthogonal(critic, 1.0, key=keys[1]))
    return PPO(online, start_adam(online, settings.learning_rate), no_moments(1))


def values(state: PPO, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch"]:
    """V(s), in units of the reward."""
    return (state.returns.mean + unit(state.returns) * state.online.critic(observation))[..., 0]


def unit(returns: Moments) -> Float[Array, " 1"]:
    """What values are measured in: the deviation of the returns, or 1 as long as they have none."""
    spread = deviation(returns)
    return jnp.where(spread > 0, spread, 1)


def advantages(
    rollout: Rollout,
    value: Float[Array, "time lanes"],
    next_value: Float[Array, "time lanes"],
    settings: PPOSettings,
) -> Float[Array, "time lanes"]:
    """Generalised advantage estimates (Schulman et al., 2016, Eq. 16), each lane backwards through time."""
    delta = rollout.reward + settings.gamma * rollout.continues * next_value - value
    carried = settings.gamma * settings.gae_lambda * (1 - rollout.ended)

    def back(later: Float[Array, " lanes"], step: tuple[Float[Array, " lanes"], Float[Array, " lanes"]]):
        advantage = step[0] + step[1] * later
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, carried), reverse=True)[1]


def policy_objective(
    ratio: Float[Array, " batch"], advantage: Float[Array, " batch"], clip: float | Array
) -> Float[Array, ""]:
    """Mean min(rho A, clip(rho, 1 - c, 1 + c) A): Schulman et al. (2017), Eq. 7."""
    return jnp.mean(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage))


def value_loss(
    value: Float[Array, " batch"], old: Float[Array, " batch"], target: Float[Array, " batch"], settings: PPOSettings
) -> Float[Array, ""]:
    """Mean of the worse of two Huber losses: that of the value, and that of the value kept near the old one."""
    near = old + jnp.clip(value - old, -settings.value_clip, settings.value_clip)
    losses = (optax.huber_loss(guess, target, delta=settings.huber_delta) for guess in (value, near))
    return jnp.mean(jnp.maximum(*losses))


def update(
    state: PPO, rollout: Rollout, key: PRNGKeyArray, left: Float[Scalar, ""], settings: PPOSettings
) -> tuple[PPO, dict[str, Float[Array, ""]]]:
    """All gradient steps on one rollout; returns the mean of each metric over them.

    `left` is the share of the run that is still to come, for annealing.
    """
    batch, returns, explained = prepare(state, rollout, settings)
    share = left if settings.anneal else 1.0
    rate, clip = settings.learning_rate * share, settings.clip * share

    def loss_of(online: Networks, rows: Minibatch) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        log_ratio = online.actor.log_probability(rows.observation, rows.action) - rows.log_probability
        ratio = jnp.exp(log_ratio)
        gain = policy_objective(ratio, rows.advantage, clip)
        loss = value_loss(online.critic(rows.observation)[:, 0], rows.value, rows.target, settings)
        entropy = jnp.mean(online.actor.entropy(rows.observation))
        total = -gain + settings.value_coef * loss - settings.entropy_coef * entropy
        return total, {
            "actor/objective": gain,
            "actor/entropy": entropy,
            "actor/approx_kl": jnp.mean(ratio - 1 - log_ratio),
            "actor/clip_fraction": jnp.mean(jnp.abs(ratio - 1) > clip),
            "critic/loss": loss,
        }

    def one(carry: tuple[Networks, optax.OptState], rows: Int[Array, " batch"]):
        online, optimizer = carry
        chosen = jax.tree.map(lambda leaf: leaf[rows], batch)
        gradient, measured = jax.grad(loss_of, has_aux=True)(online, chosen)
        shrink = settings.max_grad_norm / jnp.maximum(optax.tree.norm(gradient), settings.max_grad_norm)
        gradient = jax.tree.map(lambda leaf: leaf * shrink, gradient)
        return descend(online, gradient, optimizer, rate), measured

    order = minibatches(key, len(batch.target), settings)
    (online, optimizer), measured = jax.lax.scan(one, (state.online, state.optimizer), order)
    measured = jax.tree.map(jnp.mean, measured) | {"critic/explained_variance": explained}
    return PPO(online, optimizer, returns), measured


def prepare(state: PPO, rollout: Rollout, settings: PPOSettings) -> tuple[Minibatch, Moments, Float[Array, ""]]:
    """All steps of all agents as one batch; the statistics of their returns, these taken in; the share of the returns' variance
    that the critic knew.
    """
    value, next_value = values(state, rollout.observation), values(state, rollout.next_observation)
    advantage = advantages(rollout, value, next_value, settings)
    explained = 1 - jnp.var(advantage) / jnp.var(advantage + value)
    target = (advantage + value).reshape(-1)
    returns = observe(state.returns, target[:, None])
    centred = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    observation, action = (x.reshape(-1, x.shape[-1]) for x in (rollout.observation, rollout.action))
    log_probability = state.online.actor.log_probability(observation, action)
    said = state.online.critic(observation)[:, 0]
    target = (target - returns.mean) / unit(returns)
    return Minibatch(observation, action, log_probability, centred.reshape(-1), said, target), returns, explained


def minibatches(key: PRNGKeyArray, steps: int, settings: PPOSettings) -> Int[Array, "updates batch"]:
    """Which steps each gradient step reads: in every epoch all of them once, but for a remainder that fills no batch."""
    size = min(settings.minibatch_size, steps)
    count = steps // size
    orders = jax.vmap(lambda key: jax.random.permutation(key, steps))(jax.random.split(key, settings.epochs))
    return orders[:, : count * size].reshape(settings.epochs * count, size)
