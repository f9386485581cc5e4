"""Steps and episodes of a log, for checks of a latent function without an environment."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.envs.load import resolve_task
from lare_rl.envs.play import Episode
from lare_rl.errors import check_count
from lare_rl.latent.verify import N_SAMPLE_STEPS, Steps, evenly_spaced
from lare_rl.logs.open_log import open_log
from lare_rl.tasks.spec import TaskSpec, select_sides

__all__ = ["logged_episodes", "logged_steps"]

SAMPLED_EPISODES = 64
"""Steps are sampled from at most so many episodes, the first ones."""


def logged_steps(source: Any, task: TaskSpec | str | Path, count: int = N_SAMPLE_STEPS) -> Steps:
    """Return steps at even distances in the first episodes of a log, for `steps=` of `design` and `load_function`.

    Args:
        task: a name, a path, or a spec. Its `scored_observation` says whether phi sees the observation before a step, the one
            after it, or both. With both, a step gives two rows, and the first half of the rows are observations before a step.
        count: largest number of rows. A shorter log has fewer.

    Returns:
        Observations (n, observation size) and actions (n, action size).

    Raises:
        LareError: the log cannot be read, or `count` is not 1 or more.
    """
    check_count("count", count)
    task = resolve_task(task, playable=False)
    steps = []
    for episode in itertools.islice(open_log(source, task).episodes(), SAMPLED_EPISODES):
        selected = evenly_spaced(len(episode), count)  # a long episode need not stay in memory
        steps.append((episode.observation[selected], episode.next_observation[selected], episode.action[selected]))
    before, after, action = map(np.concatenate, zip(*steps, strict=True))
    sides = select_sides(task.scored_observation, before, after)
    rows = evenly_spaced(len(sides) * len(action), count)
    return np.concatenate(sides)[rows], np.concatenate([action] * len(sides))[rows]


def logged_episodes(source: Any, task: TaskSpec, count: int) -> list[Episode]:
    """Return the first `count` complete episodes of a log. Raises `LareError` if it cannot be read."""
    complete = (episode for episode in open_log(source, task).episodes() if episode.complete)
    return [
        Episode(
            observation=episode.observation[:, None],
            env_action=episode.action[:, None],
            next_observation=episode.next_observation[:, None],
            alive=np.ones((len(episode), 1), bool),
            reward=episode.reward[:, None],
            team_reward=episode.reward,
            group=episode.group,
        )
        for episode in itertools.islice(complete, count)
    ]
