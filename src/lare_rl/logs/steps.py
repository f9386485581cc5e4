"""Steps and episodes of a log, for checks of a latent function without an environment."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.envs.load import resolve_task
from lare_rl.envs.play import Episode
from lare_rl.latent.verify import N_SAMPLE_STEPS, Steps, evenly_spaced
from lare_rl.logs.open_log import open_log
from lare_rl.tasks.spec import TaskSpec, select_states

__all__ = ["logged_episodes", "logged_steps"]

SAMPLED_EPISODES = 64
"""Number of first episodes from which steps are sampled."""


def logged_steps(source: Any, task: TaskSpec | str | Path, count: int = N_SAMPLE_STEPS) -> Steps:
    """Return steps at even distances in the first episodes of a log, for `steps=` of `design`, `load_function` and `verified`.

    Args:
        task: a name, a path, or a spec. Its `scored_observation` says whether phi sees the observation before a step, the one
            after it, or both. With both, the first half of the rows are observations before a step.
        count: approximate number of steps. A shorter log has fewer.

    Returns:
        Observations (n, observation size) and actions (n, action size).

    Raises:
        LareError: the log cannot be read.
    """
    task = resolve_task(task, playable=False)
    observations, actions = [], []
    for episode in itertools.islice(open_log(source, task).episodes(), SAMPLED_EPISODES):
        steps = evenly_spaced(len(episode), count)
        observations.append(
            select_states(task.scored_observation, episode.observation[steps], episode.next_observation[steps])
        )
        actions.append(episode.action[steps])
    sides = [np.concatenate(side) for side in zip(*observations, strict=True)]
    observation, action = np.concatenate(sides), np.concatenate(actions * len(sides))
    rows = evenly_spaced(len(action), count)
    return observation[rows], action[rows]


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
