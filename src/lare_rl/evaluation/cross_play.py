"""Matches between the teams of two runs."""

from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lare_rl.config.train_config import TrainConfig
from lare_rl.envs.interface import JaxEnv, Team, team_mean
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import LareError, check_count
from lare_rl.runs.directory import Run
from lare_rl.tasks.spec import check_same_tasks
from lare_rl.training.collect_device import make_jax_env, unroll_on_device
from lare_rl.training.policy import make_policy
from lare_rl.training.saved_state import load_actor

__all__ = ["Match", "combine_policies", "cross_play"]


class Match(NamedTuple):
    """The first team of one run against the second team of another."""

    first: Run
    second: Run
    returns: Float[np.ndarray, "first_seeds second_seeds"]
    """The first team's mean return over the episodes, for each pair of seeds."""


def cross_play(runs: tuple[Run, Run], episodes: int = 200) -> list[Match]:
    """Let the first team of each run play against the second team of each: four matches.

    The policies sample their actions. All matches have the same random numbers, and so the same initial states.

    Raises `LareError` if the runs differ in task or algorithm, the task has other than two teams or is not in JAX, or a run has no
    checkpoint.
    """
    episodes = check_count("episodes", episodes)
    task, other_task = (run.config.task for run in runs)
    algorithm, other_algorithm = (run.config.settings.algorithm for run in runs)
    if task.name != other_task.name:
        raise LareError(f"cross-play needs two runs of one task, and these are of {task.name} and {other_task.name}")
    check_same_tasks((run.directory, run.config.task) for run in runs)
    if len(task.teams) != 2:
        raise LareError(f"cross-play needs two teams that learn, and {task.name} has {len(task.teams) or 1}")
    if algorithm != other_algorithm:
        raise LareError(f"cross-play needs runs of one algorithm, and these are of {algorithm} and {other_algorithm}")
    if not load_env_spec(task).is_jax:
        raise LareError(f"cross-play is for environments in JAX, and {task.name} steps on the host")
    players = [(run, *_load_actors(run)) for run in runs]
    play_match = jax.jit(partial(_play_match, make_jax_env(task), n_episodes=episodes, config=players[0][1]))
    matches = []
    for (run, _, first_actors), (other, _, second_actors) in product(players, repeat=2):
        returns = [[float(play_match(a, b, jax.random.key(0))) for b in second_actors] for a in first_actors]
        matches.append(Match(first=run, second=other, returns=np.array(returns)))
    return matches


def _load_actors(run: Run) -> tuple[TrainConfig, list[Any]]:
    """Load the configuration, and the actor of each seed with an axis of one seed."""
    config, actors, _ = load_actor(run)
    return config, [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], actors) for i in range(len(run.seeds))]


def _play_match(
    env: JaxEnv, first: Any, second: Any, key: PRNGKeyArray, n_episodes: int, config: TrainConfig
) -> Float[Array, ""]:
    """Return the mean over episodes of the first team's return R."""
    team = config.env.teams[0]
    policy = partial(combine_policies, policy=make_policy(config, deterministic=False), team=team)
    batch = unroll_on_device(env, (first, second), key[None], n_episodes, config, deterministic=False, act=policy)
    reward = jnp.where(batch.mask[..., None], batch.steps.next_timestep.reward, 0)  # after the end, it may be NaN
    return jnp.mean(jnp.sum(team_mean(reward, batch.steps.timestep.alive, team), axis=0))


def combine_policies(
    actors: tuple[Any, Any], memory: Any, *inputs: Any, policy: Any, team: Team
) -> tuple[Float[Array, "seeds envs agents action"], Any]:
    """Return the first team's actions by the first actor, and all other actions by the second. Neither has a memory."""
    first, second = (policy(actor, memory, *inputs)[0] for actor in actors)
    return jnp.where((jnp.arange(first.shape[-2]) < team.stop)[:, None], first, second), memory
