"""`relabel`: the same log with r_hat as rewards, and how well these predict the returns of held-out episodes.

The log is read twice as a stream. The first pass shows the episodes to a `CreditAssigner`, the second one computes their rewards
and writes them.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lare_rl.assigner.assigner import CreditAssigner
from lare_rl.credit.decoder_settings import CreditSettings
from lare_rl.credit.methods import METHODS, Reward
from lare_rl.credit.prequential import LITTLE_R2, MIN_R2_EPISODES
from lare_rl.envs.load import resolve_task
from lare_rl.errors import LareError, check_count
from lare_rl.latent.function import LatentFunction
from lare_rl.logs.episode import RelabelledEpisode
from lare_rl.logs.log import Log, batch_by_steps
from lare_rl.logs.open_log import open_log
from lare_rl.logs.payments import find_payments, make_exact, predict_payments
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.findings import Finding, render
from lare_rl.util.statistics import CONSTANT, FLOAT32_NOISE, correlation, r_squared

__all__ = ["MESSAGES", "Relabelled", "hold_out_flags", "relabel"]

BLOCK_EPISODES = 10
"""Held-out episodes are drawn from each block of this many complete episodes, so that they are spread evenly over a sorted log."""
MIN_CAPACITY = 100_000
"""The least number of steps whose inputs are stored, even if they take more than `memory`."""
UPDATES = 10_000
"""The default number of gradient updates of a decoder."""
MESSAGES = {
    "relabelled": "{method} gave rewards to {steps:count step} of {episodes:count episode}.",
    "cut": "Cut before their end, and not learned from: {episodes:count episode}.",
    "too_few": (
        "How well new returns are predicted is unknown: {episodes:count episode} held out, and {needed} are needed (--hold-out "
        "0.2, hold_out=0.2 in Python)."
    ),
    "constant": "The returns of {episodes:count episode} held out, or their predictions, are all equal: nothing can be said about "
    "these rewards.",
    "correlation": "The returns of {episodes:count episode} held out of the fit and their predictions have a correlation of "
    "{correlation:.2f}.",
    "r2": "The returns of {episodes:count episode} held out of the fit are predicted with an R² of {r2:r2}, with a standard error "
    "of {error:error}.",
    "within_groups": "Within their groups, the R² is {r2:r2}.",
    "worthless": "Warning: these rewards explain almost nothing of the differences between returns. Do not train on them.",
    "worthless_within_groups": "Warning: these rewards explain almost nothing of the differences between returns within a group. Do "
    "not train on them.",
}
"""The sentences of `Relabelled.findings`."""

Listener = Callable[[str, int, int | None], None]
"""Called with the pass ("fit" or "write"), the number of its episodes so far, and the number of all episodes; None if it is unknown."""


@dataclass(frozen=True)
class Relabelled:
    """What `relabel` wrote, and how well its rewards predict returns."""

    out: str | Path
    method: str
    calibrated: bool
    """Whether r_hat is in the unit of returns."""
    episodes: int
    steps: int
    cut: int
    """Episodes that were cut before their end. They get rewards, but nothing is learned from them."""
    returns: Sequence[float] = field(repr=False)
    """The returns of the complete episodes that were held out of the fit."""
    predictions: Sequence[float] = field(repr=False)
    """The predictions of these returns."""
    groups: Sequence[Any] = field(repr=False)
    """The groups of these episodes; empty without groups."""
    explanation: tuple[str, ...]
    """What the returns say about the factors: `CreditAssigner.explanation`."""

    @property
    def held_out(self) -> int:
        """The number of complete episodes that were held out of the fit."""
        return len(self.returns)

    @property
    def return_r2(self) -> float:
        """R^2 of their returns. NaN for fewer than `MIN_R2_EPISODES`, for equal returns, or if r_hat is not in the unit of returns."""
        return self._r2_and_error[0]

    @property
    def return_r2_error(self) -> float:
        """The standard error of `return_r2` over these episodes."""
        return self._r2_and_error[1]

    @cached_property
    def group_r2(self) -> float:
        """R^2 of the differences of these returns from the means of their groups. NaN without groups and, as for
        `return_r2`, for too few or equal returns, or if r_hat is not in the unit of returns.
        """
        return _r2_within_groups(self.returns, self.predictions, self.groups) if self.calibrated else math.nan

    @cached_property
    def return_correlation(self) -> float:
        """Pearson's correlation of these returns with their predictions.

        NaN for fewer than `MIN_R2_EPISODES`, or if the returns or the predictions are all equal.
        """
        y, predicted = np.array(self.returns), np.array(self.predictions)
        if self.held_out < MIN_R2_EPISODES:
            return math.nan
        varies = all(np.ptp(values) > FLOAT32_NOISE * np.abs(values).max() for values in (y, predicted))
        return correlation(y, predicted) if varies else math.nan

    @property
    def findings(self) -> list[Finding]:
        """The result as findings, whose sentences are in `MESSAGES`."""
        counts = {"method": self.method, "steps": self.steps, "episodes": self.episodes}
        cut = [Finding("cut", {"episodes": self.cut})] if self.cut else []
        return [Finding("relabelled", counts), *cut, *self._prediction_findings()]

    @property
    def summary(self) -> list[str]:
        """The result and the explanation as sentences."""
        return [*(render(finding, MESSAGES) for finding in self.findings), *self.explanation]

    @cached_property
    def _r2_and_error(self) -> tuple[float, float]:
        if not self.calibrated or self.held_out < MIN_R2_EPISODES:
            return math.nan, math.nan
        return r_squared(np.array(self.returns), np.array(self.predictions))

    def _prediction_findings(self) -> Iterator[Finding]:
        episodes = {"episodes": self.held_out}
        if self.held_out < MIN_R2_EPISODES:
            yield Finding("too_few", {**episodes, "needed": MIN_R2_EPISODES})
        elif not math.isnan(self.return_r2):
            yield Finding("r2", {**episodes, "r2": self.return_r2, "error": self.return_r2_error})
            if not math.isnan(self.group_r2):
                yield Finding("within_groups", {"r2": self.group_r2})
            if self.return_r2 < LITTLE_R2:
                yield Finding("worthless")
            elif self.group_r2 < LITTLE_R2:  # false for NaN
                yield Finding("worthless_within_groups")
        elif math.isnan(self.return_correlation):
            yield Finding("constant", episodes)
        else:
            yield Finding("correlation", {**episodes, "correlation": self.return_correlation})


def _r2_within_groups(returns: Sequence[float], predictions: Sequence[float], groups: Sequence[Any]) -> float:
    """Return R^2 of what differs within groups.

    NaN for fewer than `MIN_R2_EPISODES` in groups of two or more, or if the returns of each group are equal.
    """
    members = [np.flatnonzero([group == other for other in groups]) for group in dict.fromkeys(groups)]
    members = [rows for rows in members if len(rows) > 1]
    if sum(map(len, members)) < MIN_R2_EPISODES:
        return math.nan
    values = np.array([returns, predictions])
    y, predicted = np.concatenate(
        [values[:, rows] - values[:, rows].mean(axis=1, keepdims=True) for rows in members], 1
    )
    varies = np.sum(y**2) > CONSTANT * np.sum(values[0] ** 2)  # more than the rounding of the means
    return r_squared(y, predicted)[0] if varies else math.nan


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
    listener: Listener = lambda stage, n_done, n_episodes: None,
) -> Relabelled:
    """Give the steps of logged episodes rewards that are fitted to the episodes' returns.

    Args:
        source: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, a Minari id or data set,
            flat arrays by name, or a list of episodes, each a mapping of arrays (docs/reference/logs.md).
        out: the path to write, or the id of the new Minari data set. It is written completely or not at all.
        method: how credit is assigned; the default is `lare-bayes` with a `phi`, and `bayes` without.
        phi: the latent function; it needs its `task`.
        task: a name, a path, or a spec: the task that `phi` was designed for. It has the time limit and the number of discrete
            actions.
        hold_out: share of the complete episodes that are held out of the fit, to measure how well returns are predicted.
        settings: the settings of the decoder. With `exact`, the rewards of a complete episode add up to its return. With the task's
            `paid_for`, those of the steps of a payment add up to it, unless payments share steps: what each payment then lacks is
            added to its last step.
        updates: number of gradient updates of the decoder. A closed-form decoder has none.
        memory: approximate limit of the memory for the decoder's inputs, in GiB; at least 100,000 steps are stored. A closed-form fit
            uses all episodes, other fits use the last episodes that fit into it.
        seed: seed of the choice of held-out episodes and of the decoder's initial weights.
        overwrite: whether `out` is replaced if it exists.
        listener: is called after each episode, in both passes.

    Raises:
        LareError: the log is damaged or empty, `out` cannot be written or exists, or method, function and task do not fit together.
    """
    check_count("updates", updates)
    if not (isinstance(hold_out, int | float | np.number) and 0 <= hold_out <= 0.9):
        raise LareError(f"hold_out = {hold_out!r} must be between 0 and 0.9")
    if not (isinstance(memory, int | float | np.number) and 0 < memory <= 1e6):
        raise LareError(f"memory = {memory!r} must be positive, and at most 1e6 (GiB)")
    task = None if task is None else resolve_task(task, playable=False)
    log = open_log(source, task)
    log.check_output(out, overwrite)
    if task is not None and task.group is not None and not log.layout.has_groups:
        raise LareError(
            f"task {task.name!r} has group = {task.group!r}, and the first episode of {log.name} has no group (an array or a column "
            f"`group`; in Minari, infos[{task.group!r}]): add it, or remove the key from the task file"
        )
    if method is not None and METHODS.find(method).reward is Reward.UNIFORM:
        raise LareError(
            f"{method} gives all steps of an episode the same reward, and needs no relabelling: compute it from the return"
        )
    make_assigner = partial(
        CreditAssigner,
        method,
        phi,
        task=task,
        observation_space=log.layout.observation.size,  # `parse_episode` returns rows
        action_space=log.layout.action.size,
        settings=settings,
        seed=seed,
        fits_per_step=0.0,
        forget=False,
        groups=log.layout.has_groups,
    )
    bytes_per_step = make_assigner(capacity=1).store.bytes_per_step
    credit = make_assigner(capacity=max(MIN_CAPACITY, int(memory * 2**30 / bytes_per_step)))
    n_episodes, n_steps, n_cut = _fit(credit, log, hold_out_flags(hold_out, seed), updates, listener)
    explanation, held_out = tuple(credit.explanation()), _HeldOut([], [], [])
    size = n_episodes, n_steps
    episodes = _compute_rewards(credit, log, hold_out_flags(hold_out, seed), size, held_out, listener)
    name = credit.config.method.name
    comment = f"Rewards by lare-rl relabel, {name}; the old rewards are in infos['paid'], after an entry for the reset."
    path = log.write(out, episodes, overwrite, comment)
    return Relabelled(
        out=path,
        method=name,
        calibrated=credit.config.method.calibrated,
        episodes=n_episodes,
        steps=n_steps,
        cut=n_cut,
        **held_out._asdict(),
        explanation=explanation,
    )


def hold_out_flags(share: float, seed: int) -> Iterator[bool]:
    """Yield without end whether the next complete episode is held out.

    After each block of `BLOCK_EPISODES` episodes, `share` of all so far are held out, rounded down. Those of a block are random.
    """
    block = 0
    while True:
        before, after = (math.floor(n_blocks * BLOCK_EPISODES * share + 1e-9) for n_blocks in (block, block + 1))
        held_out = np.random.default_rng([seed, block]).permutation(BLOCK_EPISODES)[: after - before]
        yield from (episode in held_out for episode in range(BLOCK_EPISODES))
        block += 1


class _HeldOut(NamedTuple):
    """Episodes that were held out of the fit, as in `Relabelled`."""

    returns: list[float]
    predictions: list[float]
    groups: list[Any]


def _fit(
    credit: CreditAssigner, log: Log, is_held_out: Iterator[bool], updates: int, listener: Listener
) -> tuple[int, int, int]:
    """Fit to the complete episodes that are not held out. Return the numbers of episodes, of steps, and of cut episodes."""
    n_episodes, n_steps, n_cut, n_fitted = 0, 0, 0, 0
    for episode in log.episodes():
        if episode.complete and (episode.group is not None) != log.layout.has_groups:
            problem = "no group" if log.layout.has_groups else "a group"
            raise LareError(
                f"{episode.name} has {problem}, unlike the first episode: give all episodes a group, or none"
            )
        if episode.complete and not next(is_held_out):
            n_fitted += 1
            try:
                reward = episode.reward[-1] if episode.is_score else episode.reward
                steps = episode.observation, episode.action, episode.next_observation, reward
                credit.add_episode(*steps, group=episode.group)
                credit.fit_pending()
            except LareError as error:
                raise LareError(f"{episode.name}: {error}") from error
        n_episodes, n_steps, n_cut = n_episodes + 1, n_steps + len(episode), n_cut + (not episode.complete)
        listener("fit", n_episodes, log.n_episodes)
    if not n_fitted and credit.config.method.fit is not None:
        raise LareError(
            f"{log.name}: none of {n_episodes} episodes is complete and not held out, so there is no return to fit"
        )
    credit.fit(updates)
    return n_episodes, n_steps, n_cut


def _compute_rewards(
    credit: CreditAssigner,
    log: Log,
    is_held_out: Iterator[bool],
    size: tuple[int, int],
    held_out: _HeldOut,
    listener: Listener,
) -> Iterator[RelabelledEpisode]:
    """Yield every episode with its rewards, and add the held-out ones to `held_out`.

    Raises `LareError` if the log has another `size` than in the first pass.
    """
    is_average, n_episodes, n_steps = credit.score_type == "average", 0, 0
    # `phi` takes about as long for many steps as for few.
    for batch in batch_by_steps(log.episodes(), len):
        batch_payments = [find_payments(episode, credit.config.payments) for episode in batch]
        r_hats = credit.rewards(
            np.concatenate([episode.observation for episode in batch]),
            np.concatenate([episode.action for episode in batch]),
            np.concatenate([episode.next_observation for episode in batch]),
            length=np.concatenate([payments.step_length for payments in batch_payments]),
            begins=np.concatenate([payments.begins for payments in batch_payments]),
        )
        r_hats = np.split(r_hats, np.cumsum([len(episode) for episode in batch])[:-1])
        for episode, r_hat, payments in zip(batch, r_hats, batch_payments, strict=True):
            n_episodes, n_steps = n_episodes + 1, n_steps + len(episode)
            predicted = predict_payments(r_hat, payments, is_average=is_average)
            if episode.complete and next(is_held_out):
                held_out.returns.append(float(episode.reward.sum()))
                level = None if episode.group is None else credit.group_names.get(episode.group)
                held_out.predictions.append(credit.step_rewards.predicted_return(predicted, level, payments.length))
                if episode.group is not None:
                    held_out.groups.append(episode.group)
            if episode.complete and credit.config.spec.is_exact:
                residual = np.add.reduceat(episode.reward, payments.end - payments.n_since_last) - predicted
                r_hat = make_exact(r_hat, residual, payments, credit.config.settings)
            yield RelabelledEpisode(episode, r_hat)
            listener("write", n_episodes, size[0])
    if (n_episodes, n_steps) != size:
        before, after = (f"{episodes} episodes of {steps} steps" for episodes, steps in (size, (n_episodes, n_steps)))
        raise LareError(f"{log.name} changed while it was read: it had {before}, and now {after}")
