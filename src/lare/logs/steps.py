"""Steps and episodes of a log that a function is tried on, where there is no environment."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from lare.latent.verification.verify import STEPS, Steps
from lare.logs.source import open_logs
from lare.tasks.play import Episode
from lare.tasks.spec import TaskSpec, as_task

EPISODES = 64
"""The first ones, from which steps are taken."""


def logged_steps(source: Any, task: TaskSpec | str | Path, count: int = STEPS) -> Steps:
    """Steps from all over the first episodes of a log: for `steps=` of `design`, `load_function` and `verified`.

    Args:
        source: as of `relabel`.
        task: a name, a path, or a spec. It says which observation is judged, that before or that after a step; with `both`, the
            one after.
        count: of steps, about. Fewer where the log has fewer.

    Returns:
        Observations (n, observation size) and actions (n, action size).

    Raises:
        LareError: the log cannot be read.
    """
    task, parts = as_task(task, playable=False), []
    for episode in itertools.islice(open_logs(source, task).episodes(), EPISODES):
        observation = episode.before if task.judges == "before" else episode.after
        places = np.unique(np.linspace(0, len(episode) - 1, min(count, len(episode))).astype(int))
        parts.append((observation[places], episode.action[places]))
    observation, action = (np.concatenate(part) for part in zip(*parts, strict=True))
    chosen = np.unique(np.linspace(0, len(action) - 1, min(count, len(action))).astype(int))
    return observation[chosen], action[chosen]


def logged_episodes(source: Any, task: TaskSpec, count: int) -> list[Episode]:
    """The first whole episodes of a log, `count` of them or as many as it has. Raises `LareError` where it cannot be read."""
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
