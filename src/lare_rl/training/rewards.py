"""The rewards that the algorithm is trained on, and how close proxy rewards are to true ones."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.algorithms.batches import Metrics
from lare_rl.config.train_config import CreditConfig
from lare_rl.credit import prequential
from lare_rl.credit.decoder_settings import RECENT_STEPS
from lare_rl.credit.decoder_state import DecoderState
from lare_rl.credit.methods import Reward
from lare_rl.credit.rewards import proxy_rewards, scale_and_mask, training_rewards
from lare_rl.data import replay
from lare_rl.data.replay import StoredSteps
from lare_rl.envs.interface import Team, team_mean
from lare_rl.nn.masks import masked_mean
from lare_rl.training.decoder_inputs import alive_agents, step_batch
from lare_rl.training.learner import Learner
from lare_rl.util.statistics import FLOAT32_NOISE

__all__ = ["assess", "has_step_rewards", "masked_correlation", "mean_absolute_error", "rewards", "team_metrics"]


def rewards(
    steps: StoredSteps, decoders: tuple[DecoderState, ...], config: CreditConfig
) -> Float[Array, "*batch agents"]:
    """Return the rewards that the algorithm is trained on, for each agent."""
    alive = alive_agents(steps, config)
    team_rewards = []
    for i, (team, decoder) in enumerate(zip(config.env.teams, decoders, strict=True)):
        if config.method.has_proxy_rewards:
            team_rewards.append(training_rewards(decoder, step_batch(steps, config, i), config.credit_specs[i]))
            continue
        reward, team_alive = steps.episodic_reward[..., i, None], alive[..., team.agents]
        if config.method.reward is Reward.TRUE:
            reward = steps.columns["reward"][..., team.agents]
        reward = jnp.broadcast_to(reward, team_alive.shape)
        team_rewards.append(scale_and_mask(reward, decoder.scale, team_alive, scale_rewards=config.scale_rewards))
    return jnp.concatenate(team_rewards, axis=-1)


def assess(learner: Learner, config: CreditConfig) -> Metrics:
    """Compare the newest proxy rewards with the true rewards, over the last steps of every environment."""
    if not config.method.has_proxy_rewards:
        return {}
    buffer = learner.replay
    # Decoders of whole episodes need whole episodes: the newest iteration has them.
    count = config.rollout_steps if config.env.fixed_length else max(1, RECENT_STEPS // config.n_envs)
    index = replay.newest_steps(buffer, min(replay.capacity(buffer) - 1, count))
    oldest = replay.oldest_transition(buffer)[:, None]
    is_stored = (index.number >= oldest)[..., None]
    steps = replay.read(buffer, index._replace(number=jnp.maximum(index.number, oldest)))
    alive = alive_agents(steps, config)
    metrics: list[Metrics] = []
    for i, team in enumerate(config.env.teams):
        reward, mask = steps.columns["reward"][..., team.agents], is_stored & alive[..., team.agents]
        if config.team_level:
            reward, mask = team_mean(steps.columns["reward"], alive, team)[..., None], is_stored
        decoder = learner.decoders[i]
        r_hat = proxy_rewards(decoder, step_batch(steps, config, i), config.credit_specs[i])
        r_hat = jnp.broadcast_to(r_hat, reward.shape)
        last = jnp.broadcast_to(steps.last[..., None], reward.shape)
        rows = (values.ravel() for values in (r_hat, reward, last, mask))
        metrics.append(accuracy_metrics(*rows, calibrated=config.method.calibrated))
        if config.method.fit is not None:
            metrics[-1] |= prequential.metrics(decoder.predictions)
            if decoder.score_type_predictions is not None:
                metrics[-1]["credit/average"] = decoder.is_average.astype(jnp.float32)
                metrics[-1]["credit/log_odds"] = decoder.is_log_odds.astype(jnp.float32)
    return team_metrics(metrics, config.env.teams)


def accuracy_metrics(
    r_hat: Float[Array, " steps"],
    reward: Float[Array, " steps"],
    last: Bool[Array, " steps"],
    mask: Bool[Array, " steps"],
    calibrated: bool,
) -> dict[str, Float[Array, ""]]:
    """Return the accuracy over the steps where `mask` is true, under the keys of metrics.jsonl.

    All values are NaN if only the last steps of episodes (`last`) have a reward, because the true rewards of single steps are then
    unknown. The error is left out unless proxy rewards are in the unit of the true rewards (`calibrated`).
    """
    is_known = has_step_rewards(reward, last, mask)
    values = {"credit/correlation": masked_correlation(r_hat, reward, mask)}
    if calibrated:
        values["credit/error"] = mean_absolute_error(r_hat, reward, mask)
    return {name: jnp.where(is_known, value, jnp.nan) for name, value in values.items()}


def has_step_rewards(
    reward: Float[Array | np.ndarray, "*#steps"],
    last: Bool[Array | np.ndarray, "*#steps"],
    mask: Bool[Array | np.ndarray, "*#steps"] | bool = True,
) -> Bool[Array, ""]:
    """Return whether the true rewards of single steps are known: a step that is not the last of an episode or a segment has one."""
    return jnp.any((reward != 0) & mask & ~last)


def mean_absolute_error(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Return the mean of |r_hat - r| over the steps where `mask` is true (the paper's Table F.5)."""
    return masked_mean(jnp.abs(r_hat - reward), mask)


def masked_correlation(
    r_hat: Float[Array, " steps"], reward: Float[Array, " steps"], mask: Bool[Array, " steps"]
) -> Float[Array, ""]:
    """Return Pearson's correlation over the steps where `mask` is true, or NaN where one of the two never varies."""
    x, y = (_deviations(values, mask) for values in (r_hat, reward))
    return jnp.clip(jnp.sum(x * y) / jnp.sqrt(jnp.sum(x**2) * jnp.sum(y**2)), -1, 1)  # rounding can exceed 1


def _deviations(values: Float[Array, " steps"], mask: Bool[Array, " steps"]) -> Float[Array, " steps"]:
    """Return the deviations from the mean. Those of equal values are 0, without the rounding errors of the mean."""
    mean = masked_mean(values, mask)
    deviations = (values - mean) * mask
    return jnp.where(jnp.max(jnp.abs(deviations)) > FLOAT32_NOISE * jnp.abs(mean), deviations, 0)


def team_metrics(metrics: list[dict[str, Any]], teams: Sequence[Team]) -> dict[str, Any]:
    """Return the metrics of the first team; with several teams also the metrics of each team, with the suffix `_<team>`."""
    if len(metrics) == 1:
        return metrics[0]
    named = zip(teams, metrics, strict=True)
    return metrics[0] | {f"{name}_{team.name}": value for team, values in named for name, value in values.items()}
