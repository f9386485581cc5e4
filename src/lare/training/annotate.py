"""Applies phi: from collected steps to the factors of every judged row."""

import numpy as np
from jaxtyping import Float

from lare.data.trajectory import Trajectory
from lare.run.directory import Run
from lare.tasks.play import rows_of
from lare.training.config import TrainConfig


def annotate(run: Run, config: TrainConfig, steps: Trajectory) -> Float[np.ndarray, "*lead time envs rows factors"]:
    """The factors z of new steps: each team's `phi` on its agents' observations, or on the state; padded to the largest number."""
    lead = np.shape(steps.after.terminated)
    found = np.zeros((*lead, config.judged_rows, max(config.factors, default=0)), np.float32)
    if not run.functions:
        return found
    before, after = (host(part) for part in (steps.before, steps.after))
    taken = np.asarray(steps.taken)
    task = run.config.task
    for place, (function, team) in enumerate(zip(run.functions, config.env.teams, strict=True)):
        shown, action = rows_of(task, team, before, taken)
        led_to, _ = rows_of(task, team, after, taken)
        rows = run.factors(function, *(part.reshape(-1, part.shape[-1]) for part in (shown, action, led_to)))
        found[..., config.judged(place), : rows.shape[1]] = rows.reshape(*action.shape[:-1], -1)
    return found


def host(shown):
    """A time step with the arrays that phi may see, observation and state, on the host."""
    return shown._replace(observation=np.asarray(shown.observation), state=np.asarray(shown.state))
