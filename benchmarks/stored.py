"""The episodes that the replay of a finished run holds."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lare_rl.data import replay
from lare_rl.runs.directory import open_run
from lare_rl.training.seed_axis import of_seed
from lare_rl.training.session import load_learner


class Stored(NamedTuple):
    """The steps of one seed of one agent, in the order in which they were made."""

    after: Float[np.ndarray, "steps observation"]
    action: Float[np.ndarray, "steps action"]
    """Clipped to [-1, 1]."""
    factors: Float[np.ndarray, "steps factors"]
    reward: Float[np.ndarray, " steps"]
    ends: Int[np.ndarray, " episodes"]
    """The number of steps up to the end of each episode."""


def of_each_seed(directory: str) -> Iterator[Stored]:
    """The stored steps of each seed of a run whose method has a `phi`."""
    run = open_run(directory)
    learner = load_learner(run)[1]
    for place in range(len(run.seeds)):
        held = of_seed(learner, place).replay
        steps = replay.read(held, replay.newest(held, int(held.transitions[0])))
        after, action, factors, reward = (
            np.asarray(part)[0, :, 0]
            for part in (steps.after["observation"], *(steps.before[name] for name in ("action", "factors", "reward")))
        )
        yield Stored(after, np.clip(action, -1, 1), factors, reward, np.flatnonzero(np.asarray(steps.last)[0]) + 1)
