"""The episodes that the replay of a run holds: as logs, and for reflection."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lare_rl.data.replay import Index, Replay, end_of_episode, look_up, read
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
        actions         [T action]               in the units of the environment; [T], integers from 0, if actions are discrete
        rewards         [T]                      the true ones
        terminations    [T]                      TD3, DDPG and SAC: whether the episode ended by itself
        truncations     [T]                      TD3, DDPG and SAC: whether it reached its time limit
        group           a number                 if the task has groups

    With several agents, the first three have an axis of agents after the axis of steps. Observations are flattened.

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
        _make_log(columns, next_columns, config.env) | ({} if level is None else {"group": np.array(level)})
        for env_index in range(len(replay.row))
        for columns, next_columns, level in _finished_episodes(replay, env_index)
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
            newest = list(_finished_episodes(replay, env_index, n_newest))
            # The newest episodes of all environments ended at about the same time, so they are counted back from the newest.
            episodes += [
                (i - len(newest), replace(_make_episode(columns, next_columns, config.env, role), group=level))
                for i, (columns, next_columns, level) in enumerate(newest)
            ]
    return [episode for _, episode in sorted(episodes, key=lambda pair: pair[0])]


def _check_columns(run: Run, replay: Replay, *names: str) -> None:
    if missing := [name for name in names if name not in replay.columns]:
        raise LareError(
            f"{run.directory} does not store the column {missing[0]}: its algorithm and its method do not read it"
        )


def _finished_episodes(
    replay: Replay, env_index: int, n_newest: int | None = None
) -> Iterator[tuple[Log, Log, int | None]]:
    """Yield the columns of finished episodes of an environment, before and after each step, and the level of each episode, if any."""
    oldest, current = int(replay.oldest[env_index]), int(replay.current_episode[env_index])
    episode = jnp.arange(oldest if n_newest is None else max(oldest, current - n_newest), current)
    if not len(episode):
        return
    env = jnp.full_like(episode, env_index)
    begins, ends = np.asarray(look_up(replay.first, env, episode)), np.asarray(end_of_episode(replay, env, episode))
    number = jnp.arange(begins[0], ends[-1])
    steps = read(replay, Index(jnp.full_like(number, env_index), number))
    levels = None if steps.level is None else np.asarray(steps.level)
    arrays = jax.tree.map(np.asarray, (steps.columns, steps.next_columns))
    for begin, end in zip(begins - begins[0], ends - begins[0], strict=True):
        columns, next_columns = jax.tree.map(lambda leaf, begin=begin, end=end: leaf[begin:end], arrays)
        yield columns, next_columns, None if levels is None else int(levels[end - 1])


def _make_log(columns: Log, next_columns: Log, env: EnvSpec) -> Log:
    env_action = to_env_action(columns["action"], env)
    log = {
        "observations": np.append(columns["observation"], next_columns["observation"][-1:], axis=0),
        "actions": np.argmax(env_action, axis=-1) if env.discrete else env_action,
        "rewards": columns["reward"],
    }
    if env.n_agents == 1:
        log = {name: values[:, 0] for name, values in log.items()}
    if "terminated" not in columns:
        return log
    terminated = columns["terminated"]
    is_last = np.arange(len(terminated)) == len(terminated) - 1
    return log | {"terminations": terminated, "truncations": is_last & ~terminated}


def _make_episode(columns: Log, next_columns: Log, env: EnvSpec, role: TaskSpec) -> Episode:
    def make_timestep(columns: Log, **changes: np.ndarray) -> Timestep:
        arrays = {name: columns.get(name, np.zeros(0, np.float32)) for name in Timestep._fields if name != "measures"}
        return Timestep(**(arrays | changes), measures={})

    reward = columns["reward"]
    alive = columns.get("alive", np.ones((len(reward), env.n_agents), bool))
    timestep, next_timestep = make_timestep(columns, alive=alive), make_timestep(next_columns, reward=reward)
    return make_episode(role, env, timestep, to_env_action(columns["action"], env), next_timestep)
