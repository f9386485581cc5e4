"""`relabel`: the same log with r_hat as rewards, and how well the returns of held-out episodes are predicted.

There are two passes over the log, neither of which holds it in memory. The first shows the episodes to a `CreditAssigner`, the
second computes their rewards and writes them.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.explanation_text import error_shown, r2_shown
from lare_rl.credit.factor_fit import r2_and_error
from lare_rl.credit.methods import Reward, find_method
from lare_rl.envs.load import as_task
from lare_rl.errors import LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.logs.episode import Logged, Paid
from lare_rl.logs.source import Source, open_logs
from lare_rl.tasks.spec import TaskSpec

PIECE = 8192
"""Steps whose rewards are computed at a time: `phi` takes about as long for many steps as for few."""
BLOCK = 10
"""The share of held-out episodes is the same in every block of so many, so that it is even in a sorted log."""
FEWEST = 8
"""With fewer held-out episodes, nothing is said about their returns."""
LEAST_CAPACITY = 100_000
UPDATES = 10_000
"""Gradient updates of a decoder."""


@dataclass(frozen=True)
class Relabelled:
    """What `relabel` did, and how well its rewards predict returns."""

    out: str | Path
    method: str
    episodes: int
    steps: int
    cut: int
    """Episodes that were cut off before their end. They get rewards, but are not learned from."""
    held_out: int
    """Whole episodes that were held out of the fit."""
    return_r2: float
    """R^2 of the returns of held-out episodes; NaN if these are fewer than 8, if all their returns are the same, or if r_hat is not
    in the unit of returns."""
    return_r2_error: float
    """The standard error of `return_r2` over these episodes; NaN like it."""
    return_correlation: float
    """Pearson's correlation of these returns with their predictions; NaN if there are fewer than 8, or one side never varies."""
    explanation: tuple[str, ...]
    """What returns say about the factors: `CreditAssigner.explanation`."""

    @property
    def words(self) -> list[str]:
        """The result, as sentences."""
        steps, episodes = (number_of(*one) for one in ((self.steps, "step"), (self.episodes, "episode")))
        said = [f"{self.method} gave rewards to {steps} of {episodes}."]
        if self.cut:
            said.append(f"Cut before their end, and not learned from: {number_of(self.cut, 'episode')}.")
        said += predicted(self)
        return [*said, *self.explanation]


def number_of(count: int, name: str) -> str:
    """A number with its noun, in singular or plural."""
    return f"{count:,} {name}{'' if count == 1 else 's'}"


def predicted(found: Relabelled) -> list[str]:
    """How well unseen returns are predicted, in words."""
    if found.held_out < FEWEST:
        return [
            f"How well unseen returns are predicted is not known: {number_of(found.held_out, 'episode')} held out, and {FEWEST} "
            "are needed. Hold out a larger share (--hold-out 0.2, hold_out=0.2 in Python)."
        ]
    of = f"returns of {number_of(found.held_out, 'episode')} held out"
    if math.isnan(found.return_correlation):
        return [f"The {of}, or their predictions, are all the same: nothing can be said about these rewards."]
    if math.isnan(found.return_r2):
        return [
            f"The {of}, which nothing was fitted to, and their predictions have a correlation of {found.return_correlation:.2f}."
        ]
    said = [
        f"The {of}, which nothing was fitted to, are predicted with an R² of {r2_shown(found.return_r2)}, with a "
        f"standard error of {error_shown(found.return_r2_error)}."
    ]
    if found.return_r2 < 0.1:
        said.append(
            "Warning: that is no better than their mean. These rewards say next to nothing: do not train on them."
        )
    return said


@dataclass
class Tally:
    """Running sums over the episodes of a pass."""

    episodes: int = 0
    steps: int = 0
    cut: int = 0
    returns: list[float] = field(default_factory=list)
    """True returns of the held-out episodes."""
    predicted: list[float] = field(default_factory=list)

    def r2_and_error(self) -> tuple[float, float]:
        """R^2, and its standard error."""
        known = len(self.returns) >= FEWEST
        return r2_and_error(np.array(self.returns), np.array(self.predicted)) if known else (math.nan, math.nan)

    def correlation(self) -> float:
        """Pearson's correlation."""
        returns, predicted = np.array(self.returns), np.array(self.predicted)
        varies = len(returns) >= FEWEST and all(np.ptp(one) > 1e-6 * np.abs(one).max() for one in (returns, predicted))
        return float(np.corrcoef(returns, predicted)[0, 1]) if varies else math.nan


Told = Callable[[str, int, int | None], None]
"""Called with the name of the pass, the number of episodes so far, and the number of all episodes, if it is known."""


def relabel(
    source: Any,
    out: str | Path,
    *,
    method: str | None = None,
    phi: LatentFunction | None = None,
    task: TaskSpec | str | Path | None = None,
    hold_out: float = 0.1,
    settings: CreditSettings | None = None,
    updates: int = UPDATES,
    memory: float = 1.0,
    seed: int = 0,
    overwrite: bool = False,
    told: Told = lambda stage, done, count: None,
) -> Relabelled:
    """Give the steps of logged episodes rewards that add up to the episodes' returns.

    Args:
        source: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, a Minari id or data set,
            flat arrays by name, or a list of mappings of arrays (docs/logs.md).
        out: the path to write, or the id of the new Minari data set. It is written whole or not at all.
        method: how credit is assigned; the default is `lare-bayes` with a `phi`, and `bayes` without.
        phi: a function that judges the steps; it needs its `task`.
        task: a name, a path, or a spec: the task that `phi` was designed for. The time limit and the number of discrete actions are
            taken from it.
        hold_out: share of the whole episodes that are kept out of the fit, to measure how well returns are predicted.
        settings: settings of the decoder.
        updates: number of gradient updates of the decoder. A closed-form decoder has none.
        memory: about how many GiB the decoder's inputs may take. A closed-form fit uses all episodes, whatever this limit is; other
            fits use the last episodes that fit into it.
        seed: seed of the choice of held-out episodes and of the decoder's initial weights.
        overwrite: replace `out` if it exists.
        told: called with the progress.

    Raises:
        LareError: the log is damaged or empty, `out` cannot be written or exists, or method, function and task do not go together.
    """
    if not 0 <= hold_out <= 0.9:
        raise LareError(f"hold_out = {hold_out}: a share from 0 to 0.9")
    if not 0 < memory < math.inf or updates < 1:
        raise LareError(f"memory = {memory} and updates = {updates} must be more than 0")
    task = None if task is None else as_task(task, playable=False)
    logs = open_logs(source, task)
    logs.check_out(out, overwrite)
    name = method or ("bayes" if phi is None else "lare-bayes")
    credit = assigner(logs, name, phi, task, settings, memory, seed)
    seen = learn(credit, logs, hold_out, seed, updates, told)
    explanation, tally = tuple(credit.explanation()), Tally()
    about = f"Rewards by lare-rl relabel, {name}; the old rewards are in infos['paid'], after an entry for the reset."
    written = logs.write(out, pay(credit, logs, hold_out, seed, tally, seen, told), overwrite, about)
    r2 = tally.r2_and_error() if credit.config.method.in_reward_units else (math.nan, math.nan)
    counted = tally.episodes, tally.steps, tally.cut, len(tally.returns)
    return Relabelled(written, name, *counted, *r2, tally.correlation(), explanation)


def assigner(
    logs: Source,
    name: str,
    phi: LatentFunction | None,
    task: TaskSpec | None,
    settings: CreditSettings | None,
    memory: float,
    seed: int,
) -> CreditAssigner:
    """An assigner whose steps take about `memory` GiB."""
    if find_method(name).reward is Reward.UNIFORM:
        raise LareError(f"{name} pays all steps of an episode alike, by its return: a log needs no decoder for that")

    def made(capacity: int) -> CreditAssigner:
        return CreditAssigner(
            name,
            phi,
            task=task,
            observation_space=logs.form.observation.size,  # rows already
            action_space=logs.form.action.size,
            capacity=capacity,
            settings=settings,
            seed=seed,
            fits_per_step=0.0,
            forget=False,
        )

    row = 4 * made(1).config.basis.inputs + 16  # features, and the store's own data of each step
    return made(max(LEAST_CAPACITY, int(memory * 2**30 / row)))


def held(hold_out: float, seed: int) -> Iterator[bool]:
    """For one whole episode after the other, without end, whether it is held out: in each `BLOCK` a random share."""
    number = 0
    while True:
        share = math.floor((number + 1) * BLOCK * hold_out + 1e-9) - math.floor(number * BLOCK * hold_out + 1e-9)
        chosen = np.random.default_rng([seed, number]).permutation(BLOCK)[:share]
        yield from (place in chosen for place in range(BLOCK))
        number += 1


def learn(
    credit: CreditAssigner, logs: Source, hold_out: float, seed: int, updates: int, told: Told
) -> tuple[int, int]:
    """The first pass: fit to the whole episodes that are not held out. Returns the numbers of all episodes and of their steps."""
    out, count, steps, last = held(hold_out, seed), 0, 0, None
    for episode in logs.episodes():
        if episode.whole and not next(out):
            last = episode.name
            try:
                credit.add_episode(episode.before, episode.action, episode.after, episode.paid)
                credit.fit_owed()
            except LareError as error:
                raise LareError(f"{episode.name}: {error}") from error
        count, steps = count + 1, steps + len(episode)
        told("fit", count, logs.count)
    if last is None and credit.config.method.fit is not None:
        raise LareError(
            f"{logs.name}: none of {count} episodes is whole and not held out: there is no return to learn from"
        )
    credit.fit(updates)
    return count, steps


def pay(
    credit: CreditAssigner,
    logs: Source,
    hold_out: float,
    seed: int,
    tally: Tally,
    seen: tuple[int, int],
    told: Told,
) -> Iterator[Paid]:
    """The second pass: every episode with its rewards. The predictions for held-out episodes are added to `tally`."""
    out = held(hold_out, seed)
    for some in pieces(logs.episodes()):
        lengths = [len(episode) for episode in some]
        before, action, after = (
            np.concatenate([getattr(episode, part) for episode in some]) for part in ("before", "action", "after")
        )
        r_hat = credit.rewards(before, action, after, length=np.repeat(lengths, lengths))
        for episode, rewards in zip(some, np.split(r_hat, np.cumsum(lengths)[:-1]), strict=True):
            if episode.whole and next(out):
                tally.returns.append(float(episode.paid.sum()))
                tally.predicted.append(float(rewards.sum(dtype=np.float64)))
            tally.episodes, tally.steps = tally.episodes + 1, tally.steps + len(episode)
            tally.cut += not episode.whole
            yield Paid(episode, rewards)
            told("write", tally.episodes, seen[0])
    if (tally.episodes, tally.steps) != seen:
        raise LareError(f"{logs.name} has changed while it was read: {seen[0]} episodes first, then {tally.episodes}")


def pieces(episodes: Iterator[Logged]) -> Iterator[list[Logged]]:
    """Lists of successive episodes, each with `PIECE` steps or more in total, except the last list."""
    some, steps = [], 0
    for episode in episodes:
        some.append(episode)
        steps += len(episode)
        if steps >= PIECE:
            yield some
            some, steps = [], 0
    if some:
        yield some
