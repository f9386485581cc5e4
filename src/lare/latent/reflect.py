"""Beyond the paper: how a function's factors go with the return, told to the model; and which function predicts it best.

The judge is the plainest decoder there is: a linear map from an episode's mean factors to its R/T, fitted by ridge
regression and asked about the episodes that it has not seen.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lare.latent.function import LatentFunction
from lare.tasks.play import Episode
from lare.tasks.spec import TaskSpec

EPISODES = 40
FOLDS = 8
RIDGE = 1.0
"""Strength of the penalty, in units of one episode: factors are standardised."""


def episode_factors(
    function: LatentFunction, task: TaskSpec, episode: Episode
) -> Float[np.ndarray, "steps_and_rows factors"]:
    """The factors of an episode's steps (of all agents that acted), by the observations that the task says are judged."""
    before, action, after = (part[episode.alive] for part in (episode.before, episode.action, episode.after))
    return function.of_steps(before, action, after, task.judges)


def held_out_fit(means: Float[np.ndarray, "episodes factors"], targets: Float[np.ndarray, " episodes"]) -> float:
    """R^2 of R/T as a linear map of mean factors predicts it for episodes that it was not fitted on; 1 is perfect."""
    folds = np.arange(len(targets)) % min(FOLDS, len(targets))
    predicted = np.zeros_like(targets)
    for fold in range(int(folds.max()) + 1):
        known, asked = folds != fold, folds == fold
        centre, scale = means[known].mean(axis=0), means[known].std(axis=0) + 1e-12
        x, offset = (means[known] - centre) / scale, targets[known].mean()
        weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ (targets[known] - offset))
        predicted[asked] = (means[asked] - centre) / scale @ weights + offset
    spread = np.sum((targets - targets.mean()) ** 2)
    return float(1 - np.sum((targets - predicted) ** 2) / max(spread, 1e-12))


@dataclass(frozen=True)
class Evidence:
    """What whole episodes say of a function."""

    fit: float
    """`held_out_fit`."""
    text: str
    """For the model: each factor's range, and its correlations."""


def gather(function: LatentFunction, task: TaskSpec, episodes: list[Episode]) -> Evidence:
    """Run a function on episodes.

    Raises:
        LatentRewardError: it failed on one of them.
    """
    factors = [episode_factors(function, task, episode) for episode in episodes]
    means = np.stack([rows.mean(axis=0) for rows in factors]).astype(np.float64)
    targets = np.asarray([episode.total / len(episode.action) for episode in episodes])
    return Evidence(held_out_fit(means, targets), described(function, np.concatenate(factors), means, targets))


def described(function: LatentFunction, factors: Any, means: Any, targets: Any) -> str:
    names = (
        function.names
        if factors.shape[1] == function.size
        else [f"{name}, {when} the step" for when in ("before", "after") for name in function.names]
    )
    among = correlations(factors)
    lines = []
    for place, name in enumerate(names):
        column = factors[:, place]
        others = [f"{among[place, other]:+.2f} with {names[other]}" for other in range(len(names)) if other != place]
        strongest = sorted(others, key=lambda said: -abs(float(said.split()[0])))[:3]
        lines.append(
            f"- {name}: from {column.min():.4g} to {column.max():.4g}, mean {column.mean():.4g}, standard deviation "
            f"{column.std():.4g}; its mean over an episode correlates {correlations(means[:, place], targets):+.2f} with "
            f"the return per step; among the factors it correlates most {', '.join(strongest) or 'with none'}"
        )
    return "\n".join(lines)


def correlations(one: Any, other: Any = None) -> Any:
    """Pearson's, 0 where something does not vary."""
    with np.errstate(all="ignore"):
        found = np.corrcoef(one, rowvar=False) if other is None else np.corrcoef(one, other)[0, 1]
    return np.atleast_2d(np.nan_to_num(found)) if other is None else float(np.nan_to_num(found))
