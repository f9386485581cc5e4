"""PPO: proximal policy optimisation (Schulman et al., 2017), and IPPO, which is the same update for many agents at once.

    delta_t = r_t + gamma * (1 - terminated_t) * V(s_{t+1}) - V(s_t)
    A_t     = delta_t + gamma * lambda * (1 - done_t) * A_{t+1}      (Schulman et al., 2016)
    rho     = pi(a | s) / pi_old(a | s)
    theta  <- ascend  mean min(rho A, clip(rho, 1 - c, 1 + c) A)  -  v * value loss  +  e * entropy

Here c, v and e are the settings `clip`, `value_coef` and `entropy_coef`.

In independent PPO (de Witt et al., 2020) all agents share one actor and one critic, which see one agent's own observation
at a time. In a rollout each agent of each environment is therefore one entry of the axis `actors`. After an agent has left, its
`mask` is 0 and its steps are ignored.

The critic predicts returns standardised by their running mean and standard deviation (Yu et al., 2022), and advantages are
normalised over the rollout, so that the scale of the rewards does not matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

from lare_rl.algorithms.batches import Action, Available, Metrics, Observation, PerStep, Rollout
from lare_rl.algorithms.ppo import PPOSettings
from lare_rl.algorithms.ppo.policies import StochasticPolicy
from lare_rl.nn.masks import masked_mean
from lare_rl.nn.networks import MLP, adam_step, clip_gradient, init_adam, init_orthogonal
from lare_rl.nn.normalise import RunningMeanStd, empty_mean_std, running_std, standardise_unless_empty, update_mean_std

__all__ = ["PPO", "Actor", "act", "explore", "get_actor", "init", "logits", "update"]


class Networks(NamedTuple):
    actor: StochasticPolicy
    critic: MLP


class PPO(NamedTuple):
    """Everything that PPO learns."""

    params: Networks
    optimizer: optax.OptState
    return_rms: RunningMeanStd
    """Running statistics of the returns that the critic was fitted to."""
    observation_rms: RunningMeanStd | None
    """Running statistics that normalise the networks' observations; None if these are not normalised."""


class Actor(NamedTuple):
    """The policy, and the statistics that normalise its observations."""

    policy: StochasticPolicy
    observation_rms: RunningMeanStd | None


class Batch(NamedTuple):
    """Steps of agents, with the advantages and the targets that an update fits."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    log_probability: Float[Array, " batch"]
    """The log probability of the action under the policy that chose it."""
    advantage: Float[Array, " batch"]
    value: Float[Array, " batch"]
    """The critic's standardised output before the update. The value loss clips new outputs to within `value_clip` of it."""
    target: Float[Array, " batch"]
    """The returns, standardised by statistics that include them."""
    available: Bool[Array, "batch action"] | None
    mask: Float[Array, " batch"] | None


def init(key: PRNGKeyArray, observation_size: int, action_size: int, discrete: bool, settings: PPOSettings) -> PPO:
    """Return networks with orthogonal weights. The actor's last weights are small, so that no action is preferred at first."""
    actor_key, critic_key, *orthogonal_keys = jax.random.split(key, 4)
    actor = MLP(observation_size, settings.hidden, action_size, key=actor_key, activation=jnp.tanh)
    critic = MLP(observation_size, settings.hidden, 1, key=critic_key, activation=jnp.tanh)
    actor = init_orthogonal(actor, 0.01, key=orthogonal_keys[0])
    critic = init_orthogonal(critic, 1.0, key=orthogonal_keys[1])
    params = Networks(StochasticPolicy(actor, None if discrete else jnp.zeros(action_size)), critic)
    return PPO(
        params=params,
        optimizer=init_adam(params, settings.learning_rate),
        return_rms=empty_mean_std(1),
        observation_rms=empty_mean_std(observation_size) if settings.normalise_observations else None,
    )


def get_actor(state: PPO) -> Actor:
    """Return what is needed to act."""
    return Actor(state.params.actor, state.observation_rms)


def normalise(observation: Observation, observation_rms: RunningMeanStd | None) -> Observation:
    """Return observations as the networks receive them: normalised, if there are statistics."""
    return observation if observation_rms is None else standardise_unless_empty(observation_rms, observation)


def logits(actor: Actor, observation: Observation, available: Available) -> Action:
    """Return the logit of each choice."""
    return actor.policy.logits(normalise(observation, actor.observation_rms), available)


def act(actor: Actor, observation: Observation, available: Available) -> Action:
    """Return the most likely action."""
    return actor.policy.mode(normalise(observation, actor.observation_rms), available)


def explore(actor: Actor, observation: Observation, available: Available, noise: Action) -> Action:
    """Return an action sampled from the policy with this noise."""
    return actor.policy.sample(normalise(observation, actor.observation_rms), noise, available)


def values(state: PPO, observation: Observation) -> PerStep:
    """Return V(s) of normalised observations, in units of the reward."""
    return (state.return_rms.mean + _return_std(state.return_rms) * state.params.critic(observation))[..., 0]


def _return_std(return_rms: RunningMeanStd) -> Float[Array, " 1"]:
    """Return the unit of the critic's output: the standard deviation of the returns, or 1 while that is 0."""
    std = running_std(return_rms)
    return jnp.where(std > 0, std, 1)


def advantages(rollout: Rollout, value: PerStep, next_value: PerStep, settings: PPOSettings) -> PerStep:
    """Return generalised advantage estimates (Schulman et al., 2016, Eq. 16), computed backwards through time.

    `value` is V of the observation before each step, and `next_value` of that after it.
    """
    discount = settings.gamma * (1 - rollout.terminated)
    deltas = rollout.reward + discount * next_value - value
    decays = settings.gamma * settings.gae_lambda * (1 - rollout.done)

    def step(next_advantage: Float[Array, " actors"], inputs: tuple[Float[Array, " actors"], Float[Array, " actors"]]):
        delta, decay = inputs
        advantage = delta + decay * next_advantage
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros_like(deltas[0]), (deltas, decays), reverse=True)[1]


def policy_objective(
    ratio: PerStep, advantage: PerStep, clip: float | Array, mask: PerStep | None = None
) -> Float[Array, ""]:
    """Return the mean of min(rho A, clip(rho, 1 - c, 1 + c) A): Schulman et al. (2017), Eq. 7."""
    return masked_mean(jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage), mask)


def value_loss(
    value: PerStep, old_value: PerStep, target: PerStep, settings: PPOSettings, mask: PerStep | None = None
) -> Float[Array, ""]:
    """Return the mean of the larger of two Huber losses: of the value, and of the value clipped to `old_value` ± `value_clip`."""
    clipped = old_value + jnp.clip(value - old_value, -settings.value_clip, settings.value_clip)
    loss, clipped_loss = (optax.huber_loss(v, target, delta=settings.huber_delta) for v in (value, clipped))
    return masked_mean(jnp.maximum(loss, clipped_loss), mask)


def update(
    state: PPO, rollout: Rollout, key: PRNGKeyArray, progress_remaining: Float[Scalar, ""], settings: PPOSettings
) -> tuple[PPO, Metrics]:
    """Take all gradient steps on one rollout. Return the new state, and the mean of each metric over the steps.

    `progress_remaining` falls from 1 to 0 over the run, for annealing.
    """
    batch, return_rms, explained_variance = prepare_batch(state, rollout, settings)
    scale = progress_remaining if settings.anneal else 1.0
    rate, clip = settings.learning_rate * scale, settings.clip * scale

    def loss(params: Networks, batch: Batch) -> tuple[Float[Array, ""], Metrics]:
        actor, mask = params.actor, batch.mask
        log_ratio = actor.log_probability(batch.observation, batch.action, batch.available) - batch.log_probability
        ratio = jnp.exp(log_ratio)
        objective = policy_objective(ratio, batch.advantage, clip, mask)
        critic_loss = value_loss(params.critic(batch.observation)[:, 0], batch.value, batch.target, settings, mask)
        entropy = masked_mean(actor.entropy(batch.observation, batch.available), mask)
        total = -objective + settings.value_coef * critic_loss - settings.entropy_coef * entropy
        return total, {
            "actor/objective": objective,
            "actor/entropy": entropy,
            # Schulman, "Approximating KL divergence", 2020
            "actor/approx_kl": masked_mean(ratio - 1 - log_ratio, mask),
            "actor/clip_fraction": masked_mean((jnp.abs(ratio - 1) > clip).astype(jnp.float32), mask),
            "critic/loss": critic_loss,
        }

    def step(carry: tuple[Networks, optax.OptState], indices: Int[Array, " batch"]):
        params, optimizer = carry
        minibatch = jax.tree.map(lambda leaf: leaf[indices], batch)
        gradient, metrics = jax.grad(loss, has_aux=True)(params, minibatch)
        return adam_step(params, clip_gradient(gradient, settings.max_grad_norm), optimizer, rate), metrics

    indices = minibatch_indices(key, len(batch.target), settings)
    (params, optimizer), metrics = jax.lax.scan(step, (state.params, state.optimizer), indices)
    metrics = jax.tree.map(jnp.mean, metrics) | {"critic/explained_variance": explained_variance}

    # Only now: in the update, the policy must see observations as it did when it acted.
    observation_rms = state.observation_rms
    if observation_rms is not None:
        rows = rollout.observation.reshape(-1, rollout.observation.shape[-1])
        observation_rms = update_mean_std(observation_rms, rows, _bool_mask(rollout.mask))
    return PPO(params=params, optimizer=optimizer, return_rms=return_rms, observation_rms=observation_rms), metrics


def prepare_batch(
    state: PPO, rollout: Rollout, settings: PPOSettings
) -> tuple[Batch, RunningMeanStd, Float[Array, ""]]:
    """Return all steps of all agents as one batch, the updated statistics of the returns, and the explained variance.

    The explained variance is the share of the returns' variance that the critic predicted before the update.
    """
    mask = rollout.mask
    observation = normalise(rollout.observation, state.observation_rms)
    value = values(state, observation)
    next_value = values(state, normalise(rollout.next_observation, state.observation_rms))

    advantage = advantages(rollout, value, next_value, settings)
    explained_variance = 1 - _masked_variance(advantage, mask) / _masked_variance(advantage + value, mask)
    target = (advantage + value).reshape(-1)
    return_rms = update_mean_std(state.return_rms, target[:, None], _bool_mask(mask))
    std = jnp.sqrt(_masked_variance(advantage, mask))
    advantage = (advantage - masked_mean(advantage, mask)) / (std + 1e-8)

    observation, action = (rows.reshape(-1, rows.shape[-1]) for rows in (observation, rollout.action))
    available = None if rollout.available is None else rollout.available.reshape(-1, action.shape[-1])
    batch = Batch(
        observation=observation,
        action=action,
        log_probability=state.params.actor.log_probability(observation, action, available),
        advantage=advantage.reshape(-1),
        value=state.params.critic(observation)[:, 0],
        target=(target - return_rms.mean) / _return_std(return_rms),
        available=available,
        mask=None if mask is None else mask.ravel(),
    )
    return batch, return_rms, explained_variance


def minibatch_indices(key: PRNGKeyArray, n_steps: int, settings: PPOSettings) -> Int[Array, "updates batch"]:
    """Return the steps of each gradient step. An epoch reads all steps once, except a remainder that does not fill a batch."""
    size = min(settings.minibatch_size, n_steps)
    n_batches = n_steps // size
    epochs = jax.vmap(lambda key: jax.random.permutation(key, n_steps))(jax.random.split(key, settings.epochs))
    return epochs[:, : n_batches * size].reshape(settings.epochs * n_batches, size)


def _bool_mask(mask: Float[Array, "time actors"] | None) -> Bool[Array, " batch"] | None:
    return None if mask is None else mask.ravel() > 0


def _masked_variance(x: PerStep, mask: PerStep | None) -> Float[Array, ""]:
    return jnp.var(x) if mask is None else masked_mean((x - masked_mean(x, mask)) ** 2, mask)
