"""Steps and episodes of a log, on which a function is checked if there is no environment."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.envs.load import as_task
from lare_rl.envs.play import Episode
from lare_rl.latent.verify import STEPS, Steps
from lare_rl.logs.source import open_logs
from lare_rl.tasks.spec import TaskSpec, judged_states

EPISODES = 64
"""Steps are taken from so many first episodes."""


def logged_steps(source: Any, task: TaskSpec | str | Path, count: int = STEPS) -> Steps:
    """Steps that are spread evenly over the first episodes of a log: for `steps=` of `design`, `load_function` and `verified`.

    Args:
        source: as in `relabel`.
        task: a name, a path, or a spec. It says which observation is judged, the one before or the one after a step, or both:
            half of the rows are then observations before a step.
        count: about how many steps. A shorter log gives fewer.

    Returns:
        Observations (n, observation size) and actions (n, action size).

    Raises:
        LareError: the log cannot be read.
    """
    task, parts = as_task(task, playable=False), []
    for episode in itertools.islice(open_logs(source, task).episodes(), EPISODES):
        places = np.unique(np.linspace(0, len(episode) - 1, min(count, len(episode))).astype(int))
        sides = judged_states(task.judges, episode.before[places], episode.after[places])
        parts.append([(observation, episode.action[places]) for observation in sides])
    observation, action = (
        np.concatenate(part) for part in zip(*itertools.chain(*zip(*parts, strict=True)), strict=True)
    )
    chosen = np.unique(np.linspace(0, len(action) - 1, min(count, len(action))).astype(int))
    return observation[chosen], action[chosen]


def logged_episodes(source: Any, task: TaskSpec, count: int) -> list[Episode]:
    """The first whole episodes of a log, at most `count`. Raises `LareError` if it cannot be read."""
    whole = (episode for episode in open_logs(source, task).episodes() if episode.whole)
    return [
        Episode(
            episode.before[:, None],
            episode.action[:, None],
            episode.after[:, None],
            np.ones((len(episode), 1), bool),
            episode.paid[:, None],
            episode.paid,
        )
        for episode in itertools.islice(whole, count)
    ]
