"""Evaluation of the policies of a run, and of random actions."""

import math
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lare_rl.envs.load import check_environment
from lare_rl.envs.placement import load_env_spec, make_host_env, make_vec_env, n_open_envs
from lare_rl.envs.play import Episode, EpisodeListener, play_roles
from lare_rl.errors import LareError, check_count
from lare_rl.runs.directory import Run, as_run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.tasks.trust import trust_environment, untrusted_module
from lare_rl.training.collect_device import DeviceCollector, make_jax_env
from lare_rl.training.evaluation import Evaluation
from lare_rl.training.saved_state import SavedActor, load_actor
from lare_rl.training.streams import Stream, episode_seed
from lare_rl.training.unroll_host import evaluate_policy_on_host
from lare_rl.util.statistics import episode_error, grouped_standard_error, standard_error

__all__ = [
    "MAX_RANDOM_EPISODES",
    "MIN_RANDOM_EPISODES",
    "RANDOM_EPISODES",
    "evaluate_actor",
    "evaluate_policy",
    "evaluate_run",
    "evaluation_seeds",
    "gain_over_random",
    "mean_with_error",
    "measure_random_returns",
    "move_evaluations",
    "n_random_episodes",
    "play_random",
]

MAX_OPEN_ENVS = 20
"""Environments of a seed that are open at the same time."""
RANDOM_EPISODES = 10
"""The default number of episodes with random actions."""
MAX_RANDOM_EPISODES = 50
"""The largest number of episodes with random actions that a report plays."""
MIN_RANDOM_EPISODES = 5
"""Fewer episodes have no useful standard deviation."""
RANDOM_PLAY_S = 5.0
"""By default, the time after which no episode of random actions begins if there are `MIN_RANDOM_EPISODES`."""
FEW_EPISODES_PLAY_S = 120.0
"""The same if there are fewer."""


def evaluate_run(
    run: Run | str | Path,
    episodes: int = 10,
    best: bool = False,
    deterministic: bool = False,
    environment: str | None = None,
) -> dict[str, Float[np.ndarray, "seeds episodes"]]:
    """Return true returns by the name of the team. The name of a single team is the name of the task.

    The episodes begin in initial states that no evaluation of the run has used. Policies act as in training's evaluations: the
    choices of PPO and all actions of IPPO are sampled, other actions are deterministic. A team's return is the sum over the steps
    of the mean reward of its agents.

    Args:
        episodes: the number of episodes of each seed.
        best: play the policy of each seed's best evaluation, instead of the last policy.
        deterministic: take the most likely action, where evaluations sample actions.
        environment: play in this environment, of the same module and with the same sizes. The default is that of the run's evaluations.

    Raises:
        LareError: the run has no checkpoint, or the task's environment has changed.
    """
    run = move_evaluations(as_run(run), environment)
    returns = evaluate_policy(run, episodes, best, deterministic).returns
    return {role.name: returns[..., team_index] for team_index, role in enumerate(run.config.task.roles)}


def move_evaluations(run: Run, environment: str | None) -> Run:
    """Return the run with its evaluations in another environment, if one is named. Raise `LareError` if the run is not on the host."""
    if environment is None:
        return run
    task = run.config.task
    if load_env_spec(task).is_jax:
        raise LareError(f"{task.name}: only environments on the host can be evaluated in another environment")
    moved = {"evaluation_environment": environment}
    teams = [team.model_dump() | moved for team in task.teams]
    task = TaskSpec.model_validate(task.model_dump() | moved | {"teams": teams})
    trust_environment(task)
    return replace(run, config=run.config.model_copy(update={"task": task}))


def evaluate_policy(
    run: Run,
    episodes: int,
    best: bool = False,
    deterministic: bool = False,
    on_episode: EpisodeListener = lambda n_done: None,
) -> Evaluation:
    """Return all measurements of the episodes of `evaluate_run`, which has the same arguments and errors.

    On the host, `on_episode` is called with the number of episodes of each seed that have ended.
    """
    check_environment(run.config.task)
    return evaluate_actor(run, load_actor(run, best), episodes, deterministic, on_episode)


def evaluate_actor(
    run: Run,
    saved: SavedActor,
    episodes: int,
    deterministic: bool = False,
    on_episode: EpisodeListener = lambda n_done: None,
) -> Evaluation:
    """Return what `evaluate_policy` returns, for a policy that was loaded before."""
    task, episodes = run.config.task, check_count("episodes", episodes)
    config, actor = replace(saved.config, deterministic=deterministic or None), saved.actor
    if load_env_spec(task).is_jax:
        return DeviceCollector(make_jax_env(task), config, run.seeds).evaluate(actor, episodes, number=1)
    task, first = task.evaluation_task, run.config.settings.evaluation_episodes
    width = n_open_envs(task, len(run.seeds), min(episodes, MAX_OPEN_ENVS))
    with make_vec_env(task, width * len(run.seeds)) as envs:
        return evaluate_policy_on_host(envs, config, actor, run.seeds, episodes, first, on_episode=on_episode)


def evaluation_seeds(run: Run, episodes: int, *, in_training: bool = False) -> list[int]:
    """Return the seeds with which `evaluate_policy` resets an environment on the host, of all episodes of all seeds of the run.

    `in_training` means the evaluations during training, which play other episodes.
    """
    first = 0 if in_training else run.config.settings.evaluation_episodes
    numbers = range(first, first + episodes)
    return [episode_seed(seed, Stream.EVALUATION_EPISODES, number) for number in numbers for seed in run.seeds]


def gain_over_random(
    returns: Float[np.ndarray, "seeds episodes"], random_returns: Float[np.ndarray, " random_episodes"]
) -> tuple[float, float] | None:
    """Return the mean return minus the mean return of random actions, and the standard error of this difference.

        error^2 = var(random) / n + max(var over the seeds / seeds, mean var over the episodes / (seeds episodes))

    Returns None if there is a single episode, which has no error.
    """
    estimate = mean_with_error(returns)
    if estimate is None or len(random_returns) < 2:
        return None
    mean, error = estimate
    return float(mean - random_returns.mean()), math.hypot(standard_error(random_returns), error)


def mean_with_error(values: Float[np.ndarray, "seeds episodes"]) -> tuple[float, float] | None:
    """Return the mean and its standard error, between seeds or episodes, whichever is larger. Return None for a single episode."""
    if values.shape[1] < 2:
        return None
    error = episode_error(values.var(axis=1, ddof=1), values.shape[1])
    return float(values.mean()), grouped_standard_error(values.mean(axis=1), error)


def measure_random_returns(
    task: TaskSpec, n_episodes: int = RANDOM_EPISODES, seeds: Sequence[int] = ()
) -> Float[np.ndarray, "teams episodes"]:
    """Return the returns of `play_random`, with a time limit in proportion to the number of episodes."""
    limit_s = RANDOM_PLAY_S * n_episodes / RANDOM_EPISODES
    by_role = play_random(task, n_episodes, limit_s, seeds=seeds)
    return np.array([[episode.return_ for episode in episodes] for episodes in by_role])


def n_random_episodes(run_steps: int, longest_episode: int) -> int:
    """Return how many episodes of random actions are cheap beside a run: as many as fill a quarter of its steps, but 10 to 50."""
    return min(max(run_steps // 4 // longest_episode, RANDOM_EPISODES), MAX_RANDOM_EPISODES)


def play_random(
    task: TaskSpec,
    n_episodes: int = RANDOM_EPISODES,
    limit_s: float = RANDOM_PLAY_S,
    on_episode: EpisodeListener = lambda n_done: None,
    seeds: Sequence[int] = (),
) -> list[list[Episode]]:
    """Play `n_episodes` episodes of random actions in the environment of evaluations, and return them for each role of the task.

    There are fewer if they take longer than `limit_s` seconds (the first `MIN_RANDOM_EPISODES` may take `FEW_EPISODES_PLAY_S`), and none
    if the environment does not run, or its module is not trusted.

    Args:
        on_episode: called with the number of episodes after each.
        seeds: the environment is reset with these by turns; by default, with the numbers of the episodes.
    """
    task = task.evaluation_task
    if untrusted_module(task) is not None:
        return [[] for _ in task.roles]
    start, episodes = time.monotonic(), list[list[Episode]]()
    with suppress(LareError), closing(make_host_env(task)) as env:
        while len(episodes) < n_episodes:
            seconds = time.monotonic() - start
            if seconds >= (limit_s if len(episodes) >= MIN_RANDOM_EPISODES else max(limit_s, FEW_EPISODES_PLAY_S)):
                break
            number = len(episodes)
            seed = seeds[number % len(seeds)] if seeds else number
            episodes.append(play_roles(env, task.roles, None, np.random.default_rng(number), seed))
            on_episode(len(episodes))
    return [[by_role[role_index] for by_role in episodes] for role_index in range(len(task.roles))]
