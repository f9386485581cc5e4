"""The rewards that the algorithm is trained on, and how close they are to the true ones."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from lare_rl.algorithms.batches import Metrics
from lare_rl.credit import accuracy, engine, prequential
from lare_rl.credit.decoder_settings import RECENT_STEPS
from lare_rl.credit.decomposition import DecoderState
from lare_rl.credit.methods import Reward
from lare_rl.data import replay
from lare_rl.data.replay import StoredSteps
from lare_rl.envs.interface import Team, team_mean
from lare_rl.training.decoder_inputs import alive_agents, step_batch
from lare_rl.training.learner import Learner
from lare_rl.training.static_config import TrainConfig

__all__ = ["assess", "rewards", "team_metrics", "team_proxy_rewards"]


def rewards(
    steps: StoredSteps, decoders: tuple[DecoderState, ...], config: TrainConfig
) -> Float[Array, "*batch agents"]:
    """Return the rewards that the algorithm is trained on, for each agent."""
    alive = alive_agents(steps, config)
    team_rewards = []
    for i, (team, decoder) in enumerate(zip(config.env.teams, decoders, strict=True)):
        if config.method.has_proxy_rewards:
            team_rewards.append(engine.training_rewards(decoder, step_batch(steps, config, i), config.credit_specs[i]))
            continue
        is_dense, team_alive = config.method.reward is Reward.TRUE, alive[..., team.agents]
        reward = steps.columns["reward"][..., team.agents] if is_dense else steps.episodic_reward[..., i, None]
        reward = jnp.broadcast_to(reward, team_alive.shape)
        scaled = engine.scale_and_mask(reward, decoder.scale, team_alive, scale_rewards=config.scale_rewards)
        team_rewards.append(scaled)
    return jnp.concatenate(team_rewards, axis=-1)


def team_proxy_rewards(
    steps: StoredSteps, decoders: tuple[DecoderState, ...], config: TrainConfig, team_index: int
) -> Float[Array, "*batch rows"]:
    """Return r_hat of a team: one for each of its agents, or one for all if credit goes to whole teams."""
    batch, spec = step_batch(steps, config, team_index), config.credit_specs[team_index]
    return engine.proxy_rewards(decoders[team_index], batch, spec)


def assess(learner: Learner, config: TrainConfig) -> Metrics:
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
        r_hat = jnp.broadcast_to(team_proxy_rewards(steps, learner.decoders, config, i), reward.shape)
        last = jnp.broadcast_to(steps.last[..., None], reward.shape)
        rows = (values.ravel() for values in (r_hat, reward, last, mask))
        metrics.append(accuracy.metrics(*rows, calibrated=config.method.calibrated))
        decoder = learner.decoders[i]
        if config.method.fit is not None:
            metrics[-1] |= prequential.metrics(decoder.predictions)
            if decoder.score_type_predictions is not None:
                metrics[-1]["credit/average"] = decoder.is_average.astype(jnp.float32)
                metrics[-1]["credit/log_odds"] = decoder.is_log_odds.astype(jnp.float32)
    return team_metrics(metrics, config.env.teams)


def team_metrics(metrics: list[dict[str, Any]], teams: Sequence[Team]) -> dict[str, Any]:
    """Return the metrics of the first team; with several teams also the metrics of each team, with the suffix `_<team>`."""
    if len(metrics) == 1:
        return metrics[0]
    named = zip(teams, metrics, strict=True)
    return metrics[0] | {f"{name}_{team.name}": value for team, values in named for name, value in values.items()}
