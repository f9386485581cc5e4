"""The credit that a run's decoders give to the steps of its last training episode."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lare_rl.config.train_config import TrainConfig
from lare_rl.credit.closed_form import ClosedForm, reward_std
from lare_rl.credit.decoder_settings import RECENT_STEPS
from lare_rl.credit.decoder_state import DecoderState, score_type_index
from lare_rl.credit.methods import METHODS, Fit
from lare_rl.data import replay
from lare_rl.data.replay import Index, Replay, StoredSteps
from lare_rl.data.sampling import get_episodes
from lare_rl.envs.interface import team_mean
from lare_rl.runs.directory import Run
from lare_rl.training.decoder_inputs import alive_agents, decoder_inputs
from lare_rl.training.episodes import store_predicted_returns
from lare_rl.training.learner import Learner
from lare_rl.training.rewards import has_step_rewards, rewards
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from lare_rl.util.float64 import float64
from lare_rl.util.statistics import column_correlations

__all__ = ["EpisodeCredit", "FactorLabel", "label_factors", "load_episode_credit"]


@dataclass(frozen=True, kw_only=True)
class EpisodeCredit:
    """The last finished episode of a run's first seed and its first environment, and correlations of the factors."""

    reward: Float[np.ndarray, "steps agents"]
    """True rewards."""
    proxy_reward: Float[np.ndarray, "steps agents"]
    """By the decoders of the last checkpoint, in the unit of the return; corrected if `exact`."""
    uncertainty: Float[np.ndarray, " steps"] | None
    """Two posterior standard deviations of the proxy reward. None for many agents, and without a posterior."""
    factors: Float[np.ndarray, "steps rows factors"]
    has_step_rewards: bool
    """Whether the true rewards of single steps are known: they are not if all rewards of the newest steps are payments."""
    correlations: list[Float[np.ndarray, " _"]]
    """Pearson's correlation of each factor of each team with its true reward, over the newest steps of all seeds, about
    `RECENT_STEPS` of each. NaN if one never varies, or step rewards are not known. Without phi there are no factors."""


class FactorLabel(NamedTuple):
    """A factor, described by the source of phi."""

    name: str
    meaning: str
    reads: str
    """The entries of observation and action that it reads."""


def label_factors(run: Run, team_index: int = 0) -> list[FactorLabel]:
    """Return the labels of the factors of a team."""
    if not run.functions:
        return []
    function = run.functions[team_index]
    names = function.factor_columns(run.scored_observation)
    n_observations = len(names) // function.size  # 2 if phi scores the observations before and after a step
    return list(map(FactorLabel, names, function.meanings * n_observations, function.reads * n_observations))


def load_episode_credit(run: Run) -> EpisodeCredit | None:
    """Return the credit of a run. None for a method without proxy rewards, and while the first environment has finished no episode."""
    if not METHODS.find(run.config.settings.method).has_proxy_rewards:  # before a large checkpoint is read
        return None
    state = load_learner(run)
    config, learner = state.config, select_seed(state.learner)
    index = _find_newest_episode(learner.replay)
    if index is None:
        return None

    @jax.jit
    def read_rewards(learner: Learner, index: Index) -> tuple[StoredSteps, Float[Array, "steps agents"]]:
        if config.is_exact:  # a checkpoint may hold no predictions, or old ones
            segments = replay.segments_as_episodes(learner.replay)
            since = segments.current_episode.at[0].set(replay.look_up(segments.episode, index.env[0], index.number[0]))
            with float64():
                learner = store_predicted_returns(learner, since, config)
        steps = replay.read(learner.replay, index)
        return steps, rewards(steps, learner.decoders, replace(config, scale_rewards=False))

    steps, proxy_reward = read_rewards(learner, index)
    reward = np.asarray(steps.columns["reward"])
    newest = _read_newest(state.learner, config)
    is_known = bool(has_step_rewards(newest.columns["reward"], newest.last[..., None]))
    return EpisodeCredit(
        reward=reward,
        proxy_reward=np.asarray(proxy_reward),
        uncertainty=_uncertainty(steps, learner.decoders[0], config),
        factors=np.asarray(steps.columns.get("factors", np.zeros((len(reward), 1, 0)))),
        has_step_rewards=is_known,
        correlations=_factor_correlations(newest, config, is_known),
    )


def _uncertainty(steps: StoredSteps, decoder: DecoderState, config: TrainConfig) -> Float[np.ndarray, " steps"] | None:
    if decoder.closed_decoder is None or config.method.fit is Fit.SIGNS or config.env.n_agents > 1:
        return None
    score_types = config.credit_specs[0].score_types

    def posterior_std(closed: ClosedForm, steps: StoredSteps) -> Float[Array, " steps"]:
        index = score_type_index(decoder, len(score_types))
        return reward_std(closed, decoder_inputs(steps, config, 0)[:, 0], score_types, index)

    with float64():
        std = np.asarray(jax.jit(posterior_std)(decoder.closed_decoder, steps))
    return 2 * std / np.where(decoder.is_average, steps.length, 1)


def _find_newest_episode(buffer: Replay) -> Index | None:
    """Return the steps of the last finished episode of a seed's first environment. None if none has finished."""
    n_episodes = int(replay.n_stored_episodes(buffer)[0])
    if not n_episodes:
        return None
    newest = get_episodes(buffer, Index(jnp.int32(0), jnp.int32(n_episodes - 1)))
    return newest.steps(jnp.arange(int(newest.length)))


def _read_newest(learners: Learner, config: TrainConfig) -> StoredSteps:
    """Return about `RECENT_STEPS` newest steps of each seed, of all its environments."""
    buffers = learners.replay
    n_stored = int(np.min(jax.jit(jax.vmap(replay.n_stored_transitions))(buffers)))
    n_steps = min(max(1, RECENT_STEPS // config.n_envs), n_stored)
    return jax.jit(jax.vmap(lambda buffer: replay.read_newest(buffer, n_steps)))(buffers)


def _factor_correlations(
    steps: StoredSteps, config: TrainConfig, is_known: bool
) -> list[Float[np.ndarray, " factors"]]:
    """Compute the correlations of each team's factors with its true reward."""
    if not is_known or not config.n_factors:
        return [np.full(n_factors, np.nan) for n_factors in config.n_factors or (0,) * len(config.env.teams)]
    correlations, alive = [], np.asarray(alive_agents(steps, config))
    for i, (team, n_factors) in enumerate(zip(config.env.teams, config.n_factors, strict=True)):
        factors = np.asarray(steps.columns["factors"])[..., config.team_slice(i), :n_factors]
        reward, mask = np.asarray(steps.columns["reward"])[..., team.agents], alive[..., team.agents]
        if config.team_level:
            reward = np.asarray(team_mean(steps.columns["reward"], alive, team))[..., None]
            mask = np.ones_like(reward, bool)
        correlations.append(column_correlations(factors[mask], reward[mask]))
    return correlations
