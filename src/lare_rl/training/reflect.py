"""Reflection: a model sees how well its function explains the returns of some episodes, and tries to improve it.

The episodes are played for this purpose before training, or are those that a run has stored.
"""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.credit.basis import Basis
from lare_rl.credit.explanation_text import FEWEST, entry_names, words
from lare_rl.credit.factor_fit import Judgement
from lare_rl.credit.factor_fit import judge as judge_rows
from lare_rl.envs.load import as_task
from lare_rl.envs.play import Episode, Policy, episodes_of
from lare_rl.errors import LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.latent.improve import Evidence, Model, improve
from lare_rl.tasks.spec import TaskSpec, judged_states, the_role

EPISODES = 40
"""The number of episodes to play, if none are given."""


def reflect(
    function: LatentFunction,
    task: TaskSpec | str | Path,
    model: Model,
    rounds: int = 1,
    *,
    episodes: Sequence[Episode] | None = None,
    policy: Policy | None = None,
    record: Path | None = None,
    said: Callable[[str], None] = lambda _: None,
) -> LatentFunction:
    """Show a model how well its function explains returns; keep the function whose factors explain them best. Not in the paper.

    A function is judged by R^2 of the returns of the same episodes, each predicted before it was seen (`credit/judging.py`).
    If anything fails, the best function so far is returned.

    Args:
        function: a function from `lare_rl.design`, or written by hand.
        task: the task of the function: a name, a path, or a spec.
        model: the model to ask.
        rounds: number of rounds.
        episodes: whole episodes; by default, 40 are played.
        policy: from one observation of a single agent to one action: plays the episodes instead of random actions.
        record: a file to record every exchange in; if the design was recorded, the same file.
        said: called with messages about the progress.

    Raises:
        LareError: `rounds` is less than 1, or each team of the task has its own function.
    """
    role = the_role(as_task(task))
    if rounds < 1:
        raise LareError(f"rounds = {rounds}: at least one is needed")

    @cache
    def played() -> Sequence[Episode]:
        return episodes_of(role, EPISODES, policy) if episodes is None else episodes

    def judge(one: LatentFunction) -> Evidence:
        return evidence_of(one, role, played())

    return improve(function, role, model, judge, rounds, record, said)


class Told(NamedTuple):
    """What the returns of some episodes say about a function."""

    r2: float
    """R^2 of the returns, each predicted by the factors before it was seen; NaN if the returns are all the same."""
    r2_error: float
    """Its standard error over the episodes."""
    r2_of_lengths: float | None
    """The same, predicted by the lengths of the episodes alone; None if these do not matter."""
    sentences: list[str]
    """Sentences for the user; empty if the returns are all the same."""
    ranges: list[str]
    """A line on the values of each factor."""


def evidence_of(function: LatentFunction, role: TaskSpec, episodes: Sequence[Episode]) -> Evidence:
    """`told_by_returns` as a text for a language model. Raises `LareError` like it."""
    found = told_by_returns(function, role, episodes)
    return Evidence(found.r2, "\n".join([*found.ranges, *found.sentences]))


def told_by_returns(function: LatentFunction, role: TaskSpec, episodes: Sequence[Episode]) -> Told:
    """What the returns of some episodes say about a function.

    Raises:
        LareError: there are too few episodes, or the function failed on one of them.
    """
    if len(episodes) < FEWEST:
        raise LareError(f"{len(episodes)} episodes say too little of a function: {FEWEST} are needed")
    factors = [factors_of(function, role, episode) for episode in episodes]
    rows = [
        np.concatenate([z, *judged_states(role.judges, episode.before, episode.after), episode.action], axis=-1)
        for z, episode in zip(factors, episodes, strict=True)
    ]
    size = factors[0].shape[-1]
    basis = Basis(size, rows[0].shape[-1] - size, extended=True)
    alive, returns = [one.alive for one in episodes], np.array([one.total for one in episodes])
    found = judge_rows(rows, alive, returns, basis, role.score)
    names = function.columns_by(role.judges)
    every = np.concatenate([z[there] for z, there in zip(factors, alive, strict=True)])
    return Told(found.r2, found.r2_error, found.r2_of_lengths, said_of(found, names, role, basis), ranges(names, every))


def factors_of(function: LatentFunction, role: TaskSpec, episode: Episode) -> Float[np.ndarray, "steps rows factors"]:
    """The factors of an episode's steps, by the observations that the task says are judged; 0 for agents that have left."""
    there = episode.alive
    z = function.of_steps(episode.before[there], episode.action[there], episode.after[there], role.judges)
    found = np.zeros((*there.shape, z.shape[1]), np.float32)
    found[there] = z
    return found


def said_of(found: Judgement, names: list[str], role: TaskSpec, basis: Basis) -> list[str]:
    """The explanation in sentences, which the user reads, too."""
    return words(
        found.explanation,
        found.form,
        names,
        entry_names(role.observation, role.action, basis.used_entries, role.action_size, role.judges == "both"),
    )


def ranges(names: Sequence[str], factors: Float[np.ndarray, "rows factors"]) -> list[str]:
    """A line on each factor: the range of its values, and the factors with which it correlates most."""
    among = correlations(factors)
    lines = []
    for place, name in enumerate(names):
        column = factors[:, place]
        others = [f"{among[place, other]:+.2f} with {names[other]}" for other in range(len(names)) if other != place]
        strongest = sorted(others, key=lambda said: -abs(float(said.split()[0])))[:3]
        lines.append(
            f"- {name}: from {column.min():.4g} to {column.max():.4g}, mean {column.mean():.4g}, standard deviation "
            f"{column.std():.4g}; among the factors it correlates most {', '.join(strongest) or 'with none'}"
        )
    return lines


def correlations(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """Pearson's correlations; 0 for a column that does not vary."""
    with np.errstate(all="ignore"):
        return np.atleast_2d(np.nan_to_num(np.corrcoef(columns, rowvar=False)))
