"""The episodes that the replay of a finished run holds."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.data import replay
from lare_rl.runs.directory import open_run
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import select_seed


class Stored(NamedTuple):
    """The steps of one seed of one agent, in the order in which they were made."""

    after: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    """Clipped to [-1, 1]."""
    factors: Float[np.ndarray, "steps factors"]
    reward: Float[np.ndarray, " steps"]
    ends: Int[np.ndarray, " episodes"]
    """The number of steps up to the end of each episode."""


def stored_episodes(directory: str) -> Iterator[Stored]:
    """The stored steps of each seed of a run whose method has a `phi`."""
    run = open_run(directory)
    learner = load_learner(run)[1]
    for seed_index in range(len(run.seeds)):
        stored_replay = select_seed(learner, seed_index).replay
        steps = replay.read_newest(stored_replay, int(stored_replay.next_transition[0]))
        after, action, factors, reward = (
            np.asarray(array)[0, :, 0]
            for array in (
                steps.next_columns["observation"],
                *(steps.columns[name] for name in ("action", "factors", "reward")),
            )
        )
        yield Stored(after, np.clip(action, -1, 1), factors, reward, np.flatnonzero(np.asarray(steps.last)[0]) + 1)
