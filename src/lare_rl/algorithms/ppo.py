"""PPO: proximal policy optimisation (Schulman et al., 2017), and IPPO, which is the same update for many agents at once.

    delta_t = r_t + gamma * continues_t * V(s'_t) - V(s_t)
    A_t     = delta_t + gamma * lambda * (1 - ended_t) * A_{t+1}          (Schulman et al., 2016)
    rho     = pi(a | s) / pi_old(a | s)
    theta  <- ascend  mean min(rho A, clip(rho, 1 - c, 1 + c) A)  -  v * value loss  +  e * entropy

In independent PPO (de Witt et al., 2020) all agents share one actor and one critic, which see one agent's own observation
at a time. In this file an agent is therefore one more lane of the rollout. After an agent has left, its `mask` is 0 and its
steps are ignored.

The critic predicts returns standardised by their running mean and deviation (Yu et al., 2022), and advantages are
normalised over the rollout, so that the scale of the rewards does not matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.policies import Available, StochasticPolicy
from lare_rl.algorithms.settings import PPOSettings
from lare_rl.nn.networks import MLP, clipped, descend, orthogonal, start_adam
from lare_rl.nn.normalise import RunningMeanStd, deviation, new_mean_std, observe, standardise_if_known


class Networks(NamedTuple):
    actor: StochasticPolicy
    critic: MLP


class PPO(NamedTuple):
    """Everything that PPO learns."""

    params: Networks
    optimizer: optax.OptState
    returns: RunningMeanStd
    """Running statistics of the returns that the critic was fitted to."""
    observations: RunningMeanStd | None
    """Running statistics that normalise the networks' observations; None if these are not normalised. A rollout is added only
    after the update on it, so that the policy that is updated is the policy that acted."""


class Actor(NamedTuple):
    """What is needed to act."""

    policy: StochasticPolicy
    observations: RunningMeanStd | None


class Rollout(NamedTuple):
    """The steps that the newest policy took. A lane is one agent in one environment."""

    observation: Float[Array, "time lanes observation"]
    action: Float[Array, "time lanes action"]
    reward: Float[Array, "time lanes"]
    next_observation: Float[Array, "time lanes observation"]
    continues: Float[Array, "time lanes"]
    """0 where the episode terminated, else 1, where the target bootstraps."""
    ended: Float[Array, "time lanes"]
    """1 at the last step of an episode, terminated or truncated, and at an agent's own last step."""
    available: Bool[Array, "time lanes action"] | None = None
    """Which choices were available. None: all of them."""
    mask: Float[Array, "time lanes"] | None = None
    """1 where the agent acted, 0 where it had left. None: all 1."""


class Minibatch(NamedTuple):
    """Steps of agents, with the advantages and the targets that an update fits."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    log_probability: Float[Array, " batch"]
    """The log probability of the action under the policy that took it."""
    advantage: Float[Array, " batch"]
    value: Float[Array, " batch"]
    """The critic's output before the update, in the critic's units. The update clips changes of it to `value_clip`."""
    target: Float[Array, " batch"]
    """The returns, standardised by statistics that include them."""
    available: Bool[Array, "batch action"] | None
    mask: Float[Array, " batch"] | None


def init(key: PRNGKeyArray, observation_size: int, action_size: int, discrete: bool, settings: PPOSettings) -> PPO:
    """Orthogonal weights. The first policy hardly prefers any action, and the first values are near 0."""
    actor_key, critic_key, *keys = jax.random.split(key, 4)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key, activation=jnp.tanh)
    critic = MLP(observation_size, settings.hidden, 1, key=critic_key, activation=jnp.tanh)
    policy = StochasticPolicy(orthogonal(actor, 0.01, key=keys[0]), None if discrete else jnp.zeros(action_size))
    params = Networks(policy, orthogonal(critic, 1.0, key=keys[1]))
    observations = new_mean_std(observation_size) if settings.normalise_observations else None
    return PPO(params, start_adam(params, settings.learning_rate), new_mean_std(1), observations)


def actor_of(state: PPO) -> Actor:
    """The parts of the state that are needed to act."""
    return Actor(state.params.actor, state.observations)


def shown(
    observation: Float[Array, "*batch observation"], observations: RunningMeanStd | None
) -> Float[Array, "*batch observation"]:
    """Observations as the networks receive them: normalised, if there are statistics."""
    return observation if observations is None else standardise_if_known(observations, observation)


def act(
    actor: Actor, observation: Float[Array, "*batch observation"], available: Available
) -> Float[Array, "*batch action"]:
    """The likeliest action."""
    return actor.policy.mode(shown(observation, actor.observations), available)


def explore(
    actor: Actor,
    observation: Float[Array, "*batch observation"],
    available: Available,
    noise: Float[Array, "*batch action"],
) -> Float[Array, "*batch action"]:
    """An action sampled from the policy with the given noise."""
    return actor.policy.sample(shown(observation, actor.observations), noise, available)


def values(state: PPO, observation: Float[Array, "*batch observation"]) -> Float[Array, "*batch"]:
    """V(s), in units of the reward."""
    return (state.returns.mean + unit(state.returns) * state.params.critic(observation))[..., 0]


def unit(returns: RunningMeanStd) -> Float[Array, " 1"]:
    """The scale of the critic's values: the standard deviation of the returns, or 1 while that is 0."""
    spread = deviation(returns)
    return jnp.where(spread > 0, spread, 1)


def advantages(
    rollout: Rollout,
    value: Float[Array, "time lanes"],
    next_value: Float[Array, "time lanes"],
    settings: PPOSettings,
) -> Float[Array, "time lanes"]:
    """Generalised advantage estimates (Schulman et al., 2016, Eq. 16), computed backwards through time in each lane."""
    delta = rollout.reward + settings.gamma * rollout.continues * next_value - value
    carried = settings.gamma * settings.gae_lambda * (1 - rollout.ended)

    def back(later: Float[Array, " lanes"], step: tuple[Float[Array, " lanes"], Float[Array, " lanes"]]):
        advantage = step[0] + step[1] * later
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, carried), reverse=True)[1]


def masked_mean(values: Float[Array, "*batch"], mask: Float[Array, "*batch"] | None) -> Float[Array, ""]:
    """The mean of the values where `mask` is 1."""
    return jnp.mean(values) if mask is None else jnp.sum(values * mask) / jnp.maximum(jnp.sum(mask), 1)


def policy_objective(
    ratio: Float[Array, " batch"],
    advantage: Float[Array, " batch"],
    clip: float | Array,
    mask: Float[Array, " batch"] | None = None,
) -> Float[Array, ""]:
    """Mean min(rho A, clip(rho, 1 - c, 1 + c) A): Schulman et al. (2017), Eq. 7."""
    return masked_mean(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage), mask)


def value_loss(
    value: Float[Array, " batch"],
    old: Float[Array, " batch"],
    target: Float[Array, " batch"],
    settings: PPOSettings,
    mask: Float[Array, " batch"] | None = None,
) -> Float[Array, ""]:
    """Mean of the larger of two Huber losses: that of the value, and that of the value clipped to `value_clip` of the old one."""
    near = old + jnp.clip(value - old, -settings.value_clip, settings.value_clip)
    losses = (optax.huber_loss(guess, target, delta=settings.huber_delta) for guess in (value, near))
    return masked_mean(jnp.maximum(*losses), mask)


def update(
    state: PPO, rollout: Rollout, key: PRNGKeyArray, progress_remaining: Float[Scalar, ""], settings: PPOSettings
) -> tuple[PPO, dict[str, Float[Array, ""]]]:
    """All gradient steps on one rollout; returns the mean of each metric over them.

    `progress_remaining` is the share of the run that is still to come, for annealing.
    """
    batch, returns, explained = prepare(state, rollout, settings)
    share = progress_remaining if settings.anneal else 1.0
    rate, clip = settings.learning_rate * share, settings.clip * share

    def loss_of(params: Networks, rows: Minibatch) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
        actor, mask = params.actor, rows.mask
        log_ratio = actor.log_probability(rows.observation, rows.action, rows.available) - rows.log_probability
        ratio = jnp.exp(log_ratio)
        gain = policy_objective(ratio, rows.advantage, clip, mask)
        loss = value_loss(params.critic(rows.observation)[:, 0], rows.value, rows.target, settings, mask)
        entropy = masked_mean(actor.entropy(rows.observation, rows.available), mask)
        total = -gain + settings.value_coef * loss - settings.entropy_coef * entropy
        return total, {
            "actor/objective": gain,
            "actor/entropy": entropy,
            "actor/approx_kl": masked_mean(ratio - 1 - log_ratio, mask),
            "actor/clip_fraction": masked_mean((jnp.abs(ratio - 1) > clip).astype(jnp.float32), mask),
            "critic/loss": loss,
        }

    def one(carry: tuple[Networks, optax.OptState], rows: Int[Array, " batch"]):
        params, optimizer = carry
        chosen = jax.tree.map(lambda leaf: leaf[rows], batch)
        gradient, measured = jax.grad(loss_of, has_aux=True)(params, chosen)
        return descend(params, clipped(gradient, settings.max_grad_norm), optimizer, rate), measured

    order = minibatches(key, len(batch.target), settings)
    (params, optimizer), measured = jax.lax.scan(one, (state.params, state.optimizer), order)
    measured = jax.tree.map(jnp.mean, measured) | {"critic/explained_variance": explained}
    return PPO(params, optimizer, returns, after_rollout(state.observations, rollout)), measured


def after_rollout(observations: RunningMeanStd | None, rollout: Rollout) -> RunningMeanStd | None:
    """The statistics of the observations, with the rollout added."""
    if observations is None:
        return None
    rows = rollout.observation.reshape(-1, rollout.observation.shape[-1])
    return observe(observations, rows, None if rollout.mask is None else rollout.mask.ravel() > 0)


def prepare(state: PPO, rollout: Rollout, settings: PPOSettings) -> tuple[Minibatch, RunningMeanStd, Float[Array, ""]]:
    """All steps of all agents as one batch; the statistics of the returns, with theirs added; the share of the returns'
    variance that the critic explained.
    """
    before, after = (shown(rows, state.observations) for rows in (rollout.observation, rollout.next_observation))
    value, next_value = values(state, before), values(state, after)
    advantage = advantages(rollout, value, next_value, settings)
    mask = rollout.mask
    explained = 1 - masked_variance(advantage, mask) / masked_variance(advantage + value, mask)
    target = (advantage + value).reshape(-1)
    returns = observe(state.returns, target[:, None], None if mask is None else mask.ravel() > 0)
    spread = jnp.sqrt(masked_variance(advantage, mask))
    centred = (advantage - masked_mean(advantage, mask)) / (spread + 1e-8)
    observation, action = (x.reshape(-1, x.shape[-1]) for x in (before, rollout.action))
    available = None if rollout.available is None else rollout.available.reshape(-1, action.shape[-1])
    log_probability = state.params.actor.log_probability(observation, action, available)
    said = state.params.critic(observation)[:, 0]
    target = (target - returns.mean) / unit(returns)
    flat_mask = None if mask is None else mask.ravel()
    batch = Minibatch(observation, action, log_probability, centred.reshape(-1), said, target, available, flat_mask)
    return batch, returns, explained


def masked_variance(values: Float[Array, "*batch"], mask: Float[Array, "*batch"] | None) -> Float[Array, ""]:
    """The variance of the values where `mask` is 1."""
    return jnp.var(values) if mask is None else masked_mean((values - masked_mean(values, mask)) ** 2, mask)


def minibatches(key: PRNGKeyArray, steps: int, settings: PPOSettings) -> Int[Array, "updates batch"]:
    """The steps that each gradient step reads. An epoch reads all steps once, except a remainder that does not fill a batch."""
    size = min(settings.minibatch_size, steps)
    count = steps // size
    orders = jax.vmap(lambda key: jax.random.permutation(key, steps))(jax.random.split(key, settings.epochs))
    return orders[:, : count * size].reshape(settings.epochs * count, size)
