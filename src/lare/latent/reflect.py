"""Beyond the paper: how a function's factors go with the return, told to the model; and which function predicts it best.

The judge is the plainest decoder there is: a linear map from an episode's mean factors to its R/T (for a score that is a sum over
the steps) or to its R (for an average), whichever does better. It is fitted by ridge regression, and asked about the episodes that
it has not seen.
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


def held_out_fit(
    means: Float[np.ndarray, "episodes factors"],
    returns: Float[np.ndarray, " episodes"],
    length: Float[np.ndarray, " episodes"],
) -> float:
    """R^2 of R, as a linear map of mean factors predicts it for episodes that it was not fitted on; 1 is perfect.

    R^2 of R/T would be fooled where episodes differ in length: a factor that knows only the length predicts 1/T.
    """
    spread = max(float(np.sum((returns - returns.mean()) ** 2)), 1e-12)
    forms = length * held_out(means, returns / length), held_out(means, returns)
    return max(float(1 - np.sum((returns - predicted) ** 2) / spread) for predicted in forms)


def held_out(
    means: Float[np.ndarray, "episodes factors"], targets: Float[np.ndarray, " episodes"]
) -> Float[np.ndarray, " episodes"]:
    """Targets as a linear map of mean factors predicts them for episodes that it was not fitted on."""
    folds = np.arange(len(targets)) % min(FOLDS, len(targets))
    predicted = np.zeros_like(targets)
    for fold in range(int(folds.max()) + 1):
        known, asked = folds != fold, folds == fold
        centre, scale = means[known].mean(axis=0), means[known].std(axis=0) + 1e-12
        x, offset = (means[known] - centre) / scale, targets[known].mean()
        weights = np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), x.T @ (targets[known] - offset))
        predicted[asked] = (means[asked] - centre) / scale @ weights + offset
    return predicted


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
    returns = np.asarray([episode.total for episode in episodes], np.float64)
    length = np.asarray([len(episode.action) for episode in episodes], np.float64)
    said = described(function, np.concatenate(factors), means, returns / length)
    return Evidence(held_out_fit(means, returns, length), said)


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
