"""The episodes that the replay of a run holds: as logs, and for reflection."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from lare_rl.data.replay import Replay, end_of_episode, look_up, segments_as_episodes
from lare_rl.envs.interface import EnvSpec, Timestep, to_env_action
from lare_rl.envs.play import Episode, make_episode
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run, as_run
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed

__all__ = ["stored_episodes", "stored_role_episodes"]

MAX_ROLE_EPISODES = 200
"""The largest number of episodes for reflection, over all seeds and environments."""

Log = dict[str, np.ndarray]
"""The arrays of an episode, by name."""


def stored_episodes(run: Run | str | Path, seed: int | None = None) -> list[Log]:
    """Return the finished episodes in the replay of a run's last checkpoint, in the order of their environments and of time.

    Each is a mapping as `lare_rl.relabel` and `numpy.savez` take it, for an episode of T steps:

        observations    [T + 1 observation]      the last one is that after the last step
        actions         [T action]               in the units of the environment; [T], integers, if actions are discrete
        rewards         [T]                      the true ones
        terminations    [T]                      TD3, DDPG and SAC: whether the episode ended by itself
        truncations     [T]                      TD3, DDPG and SAC: whether it reached its time limit

        group           a number                 if the task has groups

    With many agents, the first three have an axis of agents after the axis of steps. Observations are flattened.

    Args:
        seed: one of the run's seeds; the first by default.

    Raises:
        LareError: there is no checkpoint, it does not hold such episodes, or the run has no such seed.
    """
    run = as_run(run)
    seed_index = run.seed_index(seed)
    config, learner, _, _ = load_learner(run)
    replay = select_seed(learner.replay, seed_index)
    _check_columns(run, replay, "observation", "action", "reward")
    return [
        _make_log(_env_columns(replay, env_index), rows, config.env)
        | ({} if level is None else {"group": np.array(level)})
        for env_index in range(len(replay.row))
        for rows, level in _finished_episodes(replay, env_index)
    ]


def stored_role_episodes(run: Run, role: TaskSpec) -> list[Episode]:
    """Return the newest finished episodes of all seeds from the view of a role, in the order in which they were played.

    Raises:
        LareError: there is no checkpoint, it does not hold such episodes, or the run is of another environment.
    """
    if run.config.task.environment != role.environment:
        raise LareError(
            f"{run.directory} is a run of {run.config.task.name}: its episodes are not those of {role.name}"
        )
    config, learner, _, _ = load_learner(run)
    n_newest = max(1, MAX_ROLE_EPISODES // (len(run.seeds) * config.n_envs))
    episodes = []
    for seed_index in range(len(run.seeds)):
        replay = select_seed(learner.replay, seed_index)
        _check_columns(run, replay, "state" if role.credit_scope == "state" else "observation", "action", "reward")
        for env_index in range(config.n_envs):
            columns = _env_columns(replay, env_index)
            newest = list(_finished_episodes(replay, env_index))[-n_newest:]
            # The last episodes of each environment were played at about the same time.
            episodes += [
                (i - len(newest), replace(_make_episode(columns, rows, config.env, role), group=level))
                for i, (rows, level) in enumerate(newest)
            ]
    return [episode for _, episode in sorted(episodes, key=lambda pair: pair[0])]


def _check_columns(run: Run, replay: Replay, *names: str) -> None:
    if missing := [name for name in names if name not in replay.columns]:
        raise LareError(
            f"{run.directory} does not store the column {missing[0]}: its algorithm and its method do not read it"
        )


def _env_columns(replay: Replay, env_index: int) -> dict[str, np.ndarray]:
    return {name: np.asarray(column[env_index]) for name, column in replay.columns.items()}


def _finished_episodes(replay: Replay, env_index: int) -> Iterator[tuple[Int[np.ndarray, " steps"], int | None]]:
    """Yield the rows of the steps of each finished episode, and its level, if there are levels.

    The row after the last one has the final observation.
    """
    row, first = np.asarray(replay.row[env_index]), np.asarray(replay.first[env_index])
    episode = jnp.arange(int(replay.oldest[env_index]), int(replay.current_episode[env_index]))
    env, payments = jnp.full_like(episode, env_index), segments_as_episodes(replay)
    ends = end_of_episode(replay, env, episode)
    levels: list[int | None] = [None] * len(episode)
    if payments.level is not None:
        levels = look_up(payments.level, env, look_up(payments.episode, env, ends - 1)).tolist()
    for begin, end, level in zip(first[episode % len(first)], np.asarray(ends), levels, strict=True):
        yield row[np.arange(begin, end) % len(row)], level


def _make_log(columns: Log, rows: Int[np.ndarray, " steps"], env: EnvSpec) -> Log:
    size = len(columns["observation"])
    env_action = to_env_action(columns["action"][rows % size], env)
    log = {
        "observations": columns["observation"][np.append(rows, rows[-1] + 1) % size],
        "actions": np.argmax(env_action, axis=-1) if env.discrete else env_action,
        "rewards": columns["reward"][rows % size],
    }
    if env.n_agents == 1:
        log = {name: values[:, 0] for name, values in log.items()}
    if "terminated" not in columns:
        return log
    terminated = columns["terminated"][rows % size]
    is_last = np.arange(len(rows)) == len(rows) - 1
    return log | {"terminations": terminated, "truncations": is_last & ~terminated}


def _make_episode(columns: Log, rows: Int[np.ndarray, " steps"], env: EnvSpec, role: TaskSpec) -> Episode:
    size = len(columns["reward"])

    def read(name: str, rows: np.ndarray) -> np.ndarray:
        return columns[name][rows % size] if name in columns else np.zeros(0, np.float32)

    def read_timestep(rows: np.ndarray) -> Timestep:
        arrays = {name: read(name, rows) for name in Timestep._fields if name != "measures"}
        return Timestep(**arrays, measures={})

    alive = read("alive", rows) if "alive" in columns else np.ones((len(rows), env.n_agents), bool)
    timestep = read_timestep(rows)._replace(alive=alive)
    # The reward of a step is in its own row of the replay, and what it leads to in the next one.
    next_timestep = read_timestep(rows + 1)._replace(reward=read("reward", rows))
    return make_episode(role, env, timestep, to_env_action(read("action", rows), env), next_timestep)
