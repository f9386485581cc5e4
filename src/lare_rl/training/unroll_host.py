"""Plays whole episodes of a policy in environments that step on the host, for evaluations and films."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from lare_rl.config.train_config import TrainConfig
from lare_rl.data.trajectory import Trajectory
from lare_rl.envs.env_errors import EnvOutputError, name_step
from lare_rl.envs.interface import Timestep, team_means, to_env_action
from lare_rl.envs.play import EpisodeListener
from lare_rl.envs.vec_env import VecEnv
from lare_rl.training.divergence import check_actions
from lare_rl.training.evaluation import EpisodeBatch, Evaluation
from lare_rl.training.policy import draw_noise, init_host_memory, make_host_policy
from lare_rl.training.streams import Stream, episode_seed, numpy_generator

__all__ = [
    "add_seed_axis",
    "evaluate_batch_on_host",
    "evaluate_policy_on_host",
    "evaluation_policy",
    "policy_batches",
    "record_on_host",
    "unroll_on_host",
]

BatchPolicy = Callable[[Timestep, Bool[np.ndarray, "seeds envs"]], Float[np.ndarray, "seeds envs agents action"]]
"""From a timestep, and which episodes have just begun, to the action."""


def unroll_on_host(
    envs: VecEnv, policy: BatchPolicy, seeds: Sequence[int], episode_seeds: Sequence[int]
) -> Iterator[tuple[Trajectory, Bool[np.ndarray, "seeds episodes"]]]:
    """Play one episode in each environment, all in lockstep.

    The environments of the first seed come first, then those of the second, and so on; the same is true of `episode_seeds`. If there are
    fewer episodes than environments, the last environments of each seed play none.

    Yields:
        The next step of each environment, without the axis of time, and whether its episode had not ended before. The step
        after it overwrites `next_timestep`.
    """
    shape = _batch_shape(envs, seeds)
    env_seeds, running = np.zeros(shape, np.int64), np.zeros(shape, bool)
    n_playing = len(episode_seeds) // len(seeds)
    running[:, :n_playing], env_seeds[:, :n_playing] = True, np.reshape(episode_seeds, (len(seeds), n_playing))
    episode_start = np.ones(shape, bool)
    with name_step(0):
        envs.reset(running.ravel(), env_seeds.ravel())
    next_timestep = add_seed_axis(envs.batch, shape)
    number = 0
    while running.any():
        timestep = jax.tree.map(np.copy, next_timestep)
        action = policy(timestep, episode_start)
        check_actions(action, seeds)
        env_action = to_env_action(action, envs.spec)
        number += 1
        with name_step(number):
            envs.step(env_action.reshape(-1, *env_action.shape[2:]), running.ravel())
        steps = Trajectory(timestep=timestep, action=action, env_action=env_action, next_timestep=next_timestep)
        yield steps, running
        running, episode_start = running & ~steps.ended, np.zeros(shape, bool)


def _batch_shape(envs: VecEnv, seeds: Sequence[int]) -> tuple[int, int]:
    """Return the number of seeds, and of the environments of each."""
    return len(seeds), len(envs.batch.terminated) // len(seeds)


def record_on_host(
    envs: VecEnv, policy: BatchPolicy, seeds: Sequence[int], episode_seeds: Sequence[int]
) -> EpisodeBatch:
    """Play one episode in each environment, and return all steps. The arguments are as in `unroll_on_host`."""
    played = [jax.tree.map(np.copy, rows) for rows in unroll_on_host(envs, policy, seeds, episode_seeds)]
    steps, mask = jax.tree.map(lambda *rows: np.stack(rows), *played)
    return EpisodeBatch(steps, mask, None)


def evaluate_batch_on_host(
    envs: VecEnv,
    policy: BatchPolicy,
    seeds: Sequence[int],
    n_episodes: int,
    first: int = 0,
    on_step: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Evaluate one batch: an episode in each of the first `n_episodes` environments of each seed, each from a different initial state.

    The initial states depend only on the seed and on the episode's number, which counts from `first`. So every evaluation of a
    run begins from the same ones, and no training episode does. `on_step` is called after each step of the environments.
    """
    numbers = range(first, first + n_episodes)
    episode_seeds = [episode_seed(seed, Stream.EVALUATION_EPISODES, number) for seed in seeds for number in numbers]
    spec, shape = envs.spec, _batch_shape(envs, seeds)
    returns, summed_returns = np.zeros((2, *shape, len(spec.teams)))
    lengths = np.zeros(shape, int)
    measures = {name: np.full(shape, np.nan) for name in spec.measures}
    try:
        for step, running in unroll_on_host(envs, policy, seeds, episode_seeds):
            on_step()
            timestep, next_timestep = step.timestep, step.next_timestep
            reward = next_timestep.reward.astype(np.float64) * running[..., None]
            returns += team_means(reward, timestep.alive, spec)
            summed_returns += np.stack([reward[..., team.agents].sum(axis=-1) for team in spec.teams], axis=-1)
            lengths += running
            ended = running & step.ended
            for name, values in measures.items():
                values[ended] = next_timestep.measures[name][ended]
    except EnvOutputError as error:
        where = "" if error.env_index is None else f", in an evaluation of seed {seeds[error.env_index // shape[1]]}"
        raise EnvOutputError(f"{error}{where}") from error
    results = Evaluation(returns, summed_returns, lengths, measures)
    return jax.tree.map(lambda values: values[:, :n_episodes], results)


def evaluation_policy(
    config: TrainConfig, actor: Any, seeds: Sequence[int], noise_rows: Int[np.ndarray, " episodes"], n_noise_rows: int
) -> BatchPolicy:
    """Return a policy of all seeds that has the actors' memory, for episodes that all begin with its first call.

    Noise is drawn for `n_noise_rows` episodes of each seed. These episodes use the rows `noise_rows` of it.
    """
    deterministic, n_episodes = config.deterministic_evaluation, len(noise_rows)
    policy = make_host_policy(config, actor, n_episodes, deterministic=deterministic)
    memory = init_host_memory(config, len(seeds), n_episodes)
    rngs = [numpy_generator(seed, Stream.EVALUATION_NOISE, 0) for seed in seeds]

    def act(timestep: Timestep, episode_start: Bool[np.ndarray, "seeds envs"]) -> np.ndarray:
        nonlocal memory
        noise = None if deterministic else draw_noise(config, rngs, n_noise_rows)[:, noise_rows]
        action, memory = policy(memory, timestep.observation, timestep.available, noise, episode_start)
        return action

    return act


def policy_batches(
    envs: VecEnv, config: TrainConfig, actor: Any, seeds: Sequence[int], n_episodes: int
) -> Iterator[tuple[range, BatchPolicy]]:
    """Yield the numbers of the episodes that begin together, and their policy, until each seed has `n_episodes`.

    If a seed has fewer environments, there are several batches. The noise of an episode does not depend on that.
    """
    _, width = _batch_shape(envs, seeds)
    for start in range(0, n_episodes, width):
        rows = np.minimum(np.arange(start, start + width), n_episodes - 1)
        yield range(start, min(start + width, n_episodes)), evaluation_policy(config, actor, seeds, rows, n_episodes)


def evaluate_policy_on_host(
    envs: VecEnv,
    config: TrainConfig,
    actor: Any,
    seeds: Sequence[int],
    n_episodes: int,
    first: int = 0,
    on_step: Callable[[], None] = lambda: None,
    on_episode: EpisodeListener = lambda n_done: None,
) -> Evaluation:
    """Evaluate `n_episodes` of each seed's policy. An episode does not depend on the number of environments.

    Args:
        envs: equally many environments for each seed.
        actor: the actor of all seeds.
        first: the number of the first episode, which determines its initial state.
        on_step: called after each step of the environments.
        on_episode: called with the number of episodes that each seed has finished, after each batch.
    """
    evaluations = []
    for numbers, policy in policy_batches(envs, config, actor, seeds, n_episodes):
        evaluations.append(evaluate_batch_on_host(envs, policy, seeds, len(numbers), first + numbers.start, on_step))
        on_episode(numbers.stop)
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=1), *evaluations)


def add_seed_axis(timestep: Timestep, shape: tuple[int, int]) -> Timestep:
    """Return views of the same arrays, by seeds and environments."""
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), timestep)
