"""The episodes that the replay of a run holds, as logs."""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from lare_rl.data.replay import Replay, end_of
from lare_rl.envs.interface import EnvSpec, env_action
from lare_rl.errors import LareError
from lare_rl.runs.directory import Run, as_run
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner

READ = ("observation", "action", "reward")
"""The columns of the replay that are needed."""

Episode = Mapping[str, np.ndarray]
"""The arrays of an episode, by name."""


def stored_episodes(run: Run | str | Path, seed: int | None = None) -> list[Episode]:
    """The finished episodes in the replay of a run's last checkpoint, in the order of their environments and of time.

    Each is a mapping as `lare_rl.relabel` and `numpy.savez` take it, for an episode of T steps:

        observations    [T + 1 observation]      the last one is that after the last step
        actions         [T action]               in the units of the environment; [T], integers, if actions are discrete
        rewards         [T]                      the true ones
        terminations    [T]                      TD3, DDPG and SAC: whether the episode ended by itself
        truncations     [T]                      TD3, DDPG and SAC: whether it reached its time limit

    With many agents, the first three have an axis of agents after that of steps. Observations are flattened.

    Args:
        run: the run, or its directory.
        seed: one of the run's seeds; the first by default.

    Raises:
        LareError: there is no checkpoint, it does not hold such episodes, or the run has no such seed.
    """
    run = as_run(run)
    place = run.place_of(seed)
    config, learner, _, _ = load_learner(run)
    held: Replay = of_seed(learner.replay, place)
    if missing := [name for name in READ if name not in held.columns]:
        raise LareError(
            f"{run.directory} does not store the column {missing[0]}: its algorithm and its method do not read it"
        )
    found = []
    for env in range(len(held.row)):
        row, first = np.asarray(held.row[env]), np.asarray(held.first[env])
        columns = {
            name: np.asarray(values[env]) for name, values in held.columns.items() if name in (*READ, "terminated")
        }
        episode = jnp.arange(int(held.oldest[env]), int(held.episodes[env]))
        ends = np.asarray(end_of(held, jnp.full_like(episode, env), episode))
        for begin, end in zip(first[episode % len(first)], ends, strict=True):
            found.append(episode_of(columns, row[np.arange(begin, end) % len(row)], config.env))
    return found


def episode_of(columns: Mapping[str, np.ndarray], rows: Int[np.ndarray, " steps"], env: EnvSpec) -> Episode:
    """One episode, from the numbers of the rows of its steps."""
    size = len(columns["observation"])
    action = env_action(columns["action"][rows % size], env)
    action = np.argmax(action, axis=-1) if env.discrete else action
    each = {
        "observations": columns["observation"][np.append(rows, rows[-1] + 1) % size],
        "actions": action,
        "rewards": columns["reward"][rows % size],
    }
    alone = {name: values[:, 0] if env.agents == 1 else values for name, values in each.items()}
    if "terminated" not in columns:
        return alone
    terminated = columns["terminated"][rows % size]
    last = np.arange(len(rows)) == len(rows) - 1
    return alone | {"terminations": terminated, "truncations": last & ~terminated}
