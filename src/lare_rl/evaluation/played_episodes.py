"""New episodes of a run's policy, with the credit of each agent, and samples of their steps."""

from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lare_rl.config.train_config import TrainConfig
from lare_rl.data import replay
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.interface import JaxEnv, team_means
from lare_rl.envs.placement import make_vec_env, n_open_envs
from lare_rl.envs.play import make_episode
from lare_rl.runs.directory import Run
from lare_rl.tasks.payments import is_paid
from lare_rl.training.collect_device import make_jax_env, unroll_on_device
from lare_rl.training.decoder_inputs import compute_host_factors
from lare_rl.training.episodes import store_predicted_returns
from lare_rl.training.evaluation import EpisodeBatch
from lare_rl.training.learner import Learner, empty_replay, store_with_factors
from lare_rl.training.rewards import has_step_rewards, rewards
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed
from lare_rl.training.streams import Stream, episode_seed
from lare_rl.training.unroll_host import policy_batches, record_on_host
from lare_rl.util.statistics import column_correlations

__all__ = [
    "N_SAMPLE_EPISODES",
    "PlayedEpisodes",
    "TeamSample",
    "compute_proxy_rewards",
    "play_run",
    "sample_steps",
    "unroll_policy",
]

N_SAMPLE_EPISODES = 40


@dataclass(frozen=True, kw_only=True)
class PlayedEpisodes:
    """Whole episodes of one policy, with the decoders of the first seed."""

    config: TrainConfig
    steps: Trajectory
    """[time episodes ...]."""
    mask: Bool[np.ndarray, "time episodes"]
    """True while the episode runs, false for the padding after it."""
    factors: Float[np.ndarray, "time episodes rows factors"]
    proxy_reward: Float[np.ndarray, "time episodes agents"] | None
    """By the decoders of the last checkpoint, in the unit of the return. None for a method without proxy rewards."""
    state: Any
    """The states after each step, [time episodes ...], if the environment is in JAX; else None."""

    @property
    def reward(self) -> Float[np.ndarray, "time episodes agents"]:
        """The true rewards."""
        return np.asarray(self.steps.next_timestep.reward)

    @property
    def credit(self) -> Float[np.ndarray, "time episodes agents"]:
        """The proxy rewards or, for a method without any, the true rewards."""
        return self.reward if self.proxy_reward is None else self.proxy_reward

    def select_episode(self, values: Any, episode: int = 0) -> Any:
        """Return the values of an episode until its end, [time ...], from arrays [time episodes ...]."""
        length = int(self.mask[:, episode].sum())
        return jax.tree.map(lambda leaf: leaf[:length, episode], values)


def play_run(run: Run, n_episodes: int = 1, *, actor: Any = None, key: int = 0) -> PlayedEpisodes:
    """Play episodes with sampled actions, as in training.

    Args:
        run: the run, which must have a checkpoint.
        actor: an actor with an axis of one seed; by default, that of the run's first seed.
        key: the seed of the random key, if the environment is in JAX. Others start like the first training episodes.

    Raises:
        LareError: the run has no checkpoint, or a factor is not finite.
    """
    state = load_learner(run)
    config, learner = state.config, state.learner
    if actor is None:
        actor = jax.tree.map(lambda leaf: leaf[:1], state.actor)
    if config.env.is_jax:
        batch = unroll_policy(make_jax_env(run.config.task), config, actor, n_episodes, key)
    else:
        batch = _unroll_on_host(run, config, actor, n_episodes)
    factors, proxy_reward = compute_host_factors(run, config, batch.steps), None
    if config.method.has_proxy_rewards:
        proxy_reward = compute_proxy_rewards(select_seed(learner), batch.steps, factors, config)
    return PlayedEpisodes(
        config=config,
        steps=batch.steps,
        mask=batch.mask,
        factors=factors,
        proxy_reward=proxy_reward,
        state=batch.state,
    )


def unroll_policy(env: JaxEnv, config: TrainConfig, actor: Any, n_episodes: int, key: int) -> EpisodeBatch:
    """Play whole episodes of a single seed's actor in one compiled call. The batch has no axis of seeds."""
    unroll = jax.jit(partial(unroll_on_device, env, n_episodes=n_episodes, config=config, deterministic=False))
    return _repeat_last_steps(_drop_seed_axis(unroll(actor, jax.random.key(key)[None])), config.env.max_steps)


def _unroll_on_host(run: Run, config: TrainConfig, actor: Any, n_episodes: int) -> EpisodeBatch:
    """Play as many episodes at a time as environments may be open. How many are open does not change an episode."""
    seeds, task, batches = run.seeds[:1], run.config.task, []
    with make_vec_env(task, n_open_envs(task, 1, n_episodes)) as envs:
        for numbers, policy in policy_batches(envs, replace(config, deterministic=False), actor, seeds, n_episodes):
            episode_seeds = [episode_seed(seeds[0], Stream.TRAINING_EPISODES, number) for number in numbers]
            batch = _drop_seed_axis(record_on_host(envs, policy, seeds, episode_seeds))
            batches.append(jax.tree.map(itemgetter(np.s_[:, : len(numbers)]), batch))
    n_steps = max(len(batch.mask) for batch in batches)
    batches = [_repeat_last_steps(batch, n_steps) for batch in batches]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *batches)


def _repeat_last_steps(batch: EpisodeBatch, n_steps: int) -> EpisodeBatch:
    """Return a batch of `n_steps` steps, with the last step of each episode repeated: after it, an environment may pay or show NaN."""
    time = np.arange(n_steps)[:, None]
    steps = np.minimum(time, batch.mask.sum(axis=0) - 1)
    repeated = jax.tree.map(lambda leaf: leaf[steps, np.arange(steps.shape[1])], batch)
    return repeated._replace(mask=time == steps)


def _drop_seed_axis(batch: EpisodeBatch) -> EpisodeBatch:
    return jax.tree.map(lambda leaf: leaf[:, 0], jax.device_get(batch))


def compute_proxy_rewards(
    learner: Learner, steps: Trajectory, factors: Float[np.ndarray, "time episodes rows factors"], config: TrainConfig
) -> Float[np.ndarray, "time episodes agents"]:
    """Compute the proxy rewards of whole episodes by the decoders of a single seed, in the unit of the return."""
    n_steps, n_episodes = np.shape(steps.next_timestep.terminated)
    # Rewards are computed from stored steps, so a new replay stores these episodes alone. Each repeated last step is stored as an
    # episode of two rows.
    buffer = empty_replay(config, n_episodes, 2 * n_steps + 2)

    @jax.jit
    def compute(steps: Trajectory, factors: Array) -> Array:
        filled = store_with_factors(learner._replace(replay=buffer), steps, factors, config)
        if config.is_exact:
            since = replay.segments_as_episodes(filled.replay).oldest
            filled = store_predicted_returns(filled._replace(decoders=learner.decoders), since, config)
        stored = replay.read_newest(filled.replay, n_steps)
        return jnp.swapaxes(rewards(stored, learner.decoders, replace(config, scale_rewards=False)), 0, 1)

    return np.asarray(compute(jax.tree.map(jnp.asarray, steps), jnp.asarray(factors)))


@dataclass(frozen=True, kw_only=True)
class TeamSample:
    """Steps of one team in some episodes. A row is a step of an agent or, if phi reads the state, of the team."""

    next_observation: Float[np.ndarray, "rows observation"]
    """The observation, or the state, after the step."""
    factors: Float[np.ndarray, "rows factors"]
    reward: Float[np.ndarray, " rows"]
    """The true reward."""
    has_step_rewards: bool
    """Whether the true rewards of single steps are known: they are not if only steps with a payment have one."""

    @property
    def correlations(self) -> Float[np.ndarray, " factors"]:
        """Pearson's correlation of each factor with the true reward. NaN if one of the two never varies, or step rewards are unknown."""
        if not self.has_step_rewards:
            return np.full(self.factors.shape[-1], np.nan)
        return column_correlations(self.factors, self.reward)


def sample_steps(run: Run, actor: Any = None) -> list[TeamSample]:
    """Return steps of each team, from `N_SAMPLE_EPISODES` episodes of `play_run`."""
    played = play_run(run, N_SAMPLE_EPISODES, actor=actor, key=1)
    config, samples = played.config, []
    ended = played.mask & ~np.append(played.mask[1:], np.zeros_like(played.mask[:1]), axis=0)
    # Of the steps that a payment is for.
    team_reward = team_means(played.reward, np.asarray(played.steps.timestep.alive), config.env)
    is_last = is_paid(config.payments, np.arange(len(ended))[:, None], team_reward, ended)
    is_known = bool(has_step_rewards(team_reward, is_last[..., None], played.mask[..., None]))
    steps = jax.tree.map(lambda leaf: np.asarray(leaf)[played.mask], played.steps)  # [steps ...]
    for team_index, role in enumerate(run.config.task.roles):  # its rows of all episodes, as if they were one
        rows = make_episode(role, config.env, steps.timestep, steps.env_action, steps.next_timestep)
        n_factors = config.n_factors[team_index] if config.n_factors else 0
        factors = played.factors[played.mask][:, config.team_slice(team_index), :n_factors]
        next_observation, factors, reward = (x[rows.alive] for x in (rows.next_observation, factors, rows.reward))
        samples.append(
            TeamSample(next_observation=next_observation, factors=factors, reward=reward, has_step_rewards=is_known)
        )
    return samples
