"""The scores of a comparison, as arrays.

The *score of a run* is the value of the metric at an evaluation. Scores of different tasks have no common scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.compare.results import LearningCurve, group_pairs
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN
from lare_rl.tasks.spec import check_same_tasks

__all__ = ["LAST_RETURN", "LabelScores", "ScoreChoice", "group_results", "last_quarter"]


class ScoreChoice(NamedTuple):
    """Which values of the runs are compared."""

    metric: str = RETURN
    """The name of the metric."""
    step: int | None = None
    """The step at which runs are compared; None for the last one at which all have a value."""
    average_last_quarter: bool = False
    """Whether the final scores are means over the last quarter of the steps up to `step`."""


LAST_RETURN = ScoreChoice()
"""The true return at the last step."""


@dataclass(frozen=True)
class LabelScores:
    """The scores of one label on a task. The axis `tasks` has the length 1."""

    label: str
    task: str
    seeds: tuple[int, ...]
    draws: tuple[int, ...]
    steps: tuple[int, ...]
    scores: Float[np.ndarray, "draws seeds tasks steps"]
    final_scores: Float[np.ndarray, "draws seeds tasks"]
    """The scores at the last step, or their means over the last quarter of the steps."""

    @property
    def seed_scores(self) -> Float[np.ndarray, "seeds tasks"]:
        """The final scores, averaged over the draws."""
        return self.final_scores.mean(axis=0)


_CurveKey = tuple[str, str, int, int]
"""Label, task, draw and seed of a curve."""


def group_results(results: Sequence[LearningCurve], choice: ScoreChoice = LAST_RETURN) -> list[LabelScores]:
    """Return the scores of each label: a method, and what distinguishes it from other rows.

    Raises `LareError` if there are no results, they are of several tasks, a label lacks a draw or seed, or not all results have a
    value at the chosen step.
    """
    if not results:
        raise LareError("there are no results to compare")
    tasks = sorted({curve.task for curve in results})
    if len(tasks) > 1:
        raise LareError(f"scores have no common scale over {', '.join(tasks)}: compare each task alone")
    check_same_tasks((curve.source, curve.config.task) for curve in results if curve.config is not None)
    curves = _index_curves(results, choice.metric)
    steps = _shared_steps(curves, choice)
    n_final = len(last_quarter(steps)) if choice.average_last_quarter else 1
    by_label = group_pairs((curve.label, curve) for curve in curves.values())
    return [_stack_scores(label, tasks[0], group, steps, n_final) for label, group in by_label.items()]


def _stack_scores(
    label: str, task: str, curves: Sequence[LearningCurve], steps: Sequence[int], n_final: int
) -> LabelScores:
    """Return the scores of a label, whose final ones are of the last `n_final` steps. Raises `LareError` if it lacks a draw or seed."""
    values = {(curve.draw, curve.seed): curve.values for curve in curves}
    draws, seeds = (tuple(sorted(set(numbers))) for numbers in zip(*values, strict=True))
    scores = np.empty((len(draws), len(seeds), 1, len(steps)))
    for (i, draw), (j, seed) in product(enumerate(draws), enumerate(seeds)):
        if (draw, seed) not in values:
            raise LareError(
                f"{label} has no run on {task} with seed {seed} and draw {draw}, and needs the same seeds for every draw: train it, "
                "or add it to the table"
            )
        scores[i, j, 0] = [values[draw, seed][step] for step in steps]
    final_scores = scores[..., -n_final:].mean(axis=-1)
    return LabelScores(label, task, seeds, draws, tuple(steps), scores, final_scores)


def last_quarter(steps: Sequence[int]) -> list[int]:
    """Return the steps above 3/4 of the last step. `steps` are ascending."""
    return [step for step in steps if 4 * step > 3 * steps[-1]]


def _index_curves(results: Sequence[LearningCurve], metric: str) -> dict[_CurveKey, LearningCurve]:
    """Return the curves by key. Raise `LareError` if a curve has no value, or two have the same key."""
    curves: dict[_CurveKey, LearningCurve] = {}
    # A table has only draw 0, and a label needs every seed in every draw. So a table cannot share one with runs of further draws.
    run_sources = {curve.label: curve.source for curve in reversed(results) if curve.draw != 0}
    for curve in results:
        source, label = curve.source, curve.label
        if curve.config is None and label in run_sources:
            raise LareError(
                f"{source} and {run_sources[label]} both have {label}, and a table has no draws: rename the method in the .csv file"
            )
        other = curves.setdefault((label, curve.task, curve.draw, curve.seed), curve)
        if other is not curve:
            hint = "" if curve.config and other.config else ", or rename the method in the .csv file"
            raise LareError(
                f"{source} and {other.source} both have {label} on {curve.task} with seed {curve.seed} and draw {curve.draw}: leave "
                f"out one{hint}"
            )
        if not curve.values:
            raise LareError(f"{source} has no {metric} of seed {curve.seed}: leave it out")
    return curves


def _shared_steps(curves: Mapping[_CurveKey, LearningCurve], choice: ScoreChoice) -> list[int]:
    """Return the steps at which all curves have a value, up to the chosen step. Raise `LareError` if there are none."""
    metric, step = choice.metric, choice.step
    steps = sorted(set.intersection(*(set(curve.values) for curve in curves.values())))
    if not steps:
        steps_of_seeds = group_pairs(
            ((curve.label, curve.task, curve.source), curve.values) for curve in curves.values()
        )
        spans = [
            f"{label} on {task} in {source}: {min(map(min, values)):,} to {max(map(max, values)):,}"
            for (label, task, source), values in steps_of_seeds.items()
        ]
        raise LareError(f"no step has a value of {metric} in all runs ({'; '.join(spans)})")
    if step is None:
        return steps
    if step not in steps:
        texts = [f"{shared:,}" for shared in steps]
        texts = texts if len(texts) <= 6 else [*texts[:3], "...", texts[-1]]
        raise LareError(f"not all runs have a value of {metric} at step {step:,}; all have one at {', '.join(texts)}")
    return [shared for shared in steps if shared <= step]
