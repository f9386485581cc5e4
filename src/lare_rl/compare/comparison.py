"""The statistics of a comparison.

The score of a seed is the mean over its draws of the language model. Intervals are of nominal 95%, by stratified bootstrap over the
seeds (`bootstrap.py`): for few seeds they are too narrow, as docs/reference/comparisons.md shows. A method that was trained on several
draws has a second interval, over the draws. The score of a draw is the mean over its seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lare_rl.compare.bootstrap import (
    Estimate,
    OtherScores,
    Scores,
    bootstrap,
    estimate,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    two_sided_p,
)
from lare_rl.compare.results import LearningCurve
from lare_rl.compare.scores import LAST_RETURN, LabelScores, ScoreChoice, group_results
from lare_rl.util.statistics import Band, sample_std

__all__ = ["Comparison", "OverallRow", "Row", "compare", "compare_over_tasks", "compare_tasks"]


@dataclass(frozen=True)
class OverallRow:
    """One method compared with the baseline, on a task or over several."""

    label: str
    n_seeds: int
    probability_of_improvement: Estimate | None
    """Probability that a seed scores more than one of the baseline; None for the baseline and for single seeds."""
    p_value: float | None
    """The two-sided p-value of the Mann-Whitney test against the baseline; None like `probability_of_improvement`."""


@dataclass(frozen=True)
class Row(OverallRow):
    """One method on a task."""

    n_draws: int
    iqm: Estimate
    """Interquartile mean, its interval over the seeds."""
    mean: float
    std: float | None
    """Standard deviation over the seeds; None for a single seed."""
    draw_mean: Estimate | None
    """The mean, its interval over the draws; None for a single draw."""
    difference: Estimate | None
    """The interquartile mean minus that of the baseline; None like `probability_of_improvement`."""


@dataclass(frozen=True)
class Comparison:
    """The statistics of some methods on a task. The first method is the baseline."""

    rows: tuple[Row, ...]
    curves: Mapping[str, Band]
    """The interquartile mean at each step, by label."""
    profiles: Mapping[str, Band]
    """The share of seeds that score more than x, by label."""
    groups: Mapping[str, LabelScores]
    """The scores, by label."""
    choice: ScoreChoice

    @property
    def task(self) -> str:
        """The name of the task."""
        return self.groups[self.rows[0].label].task

    @property
    def last_step(self) -> int:
        """The step at which runs are compared."""
        return self.groups[self.rows[0].label].steps[-1]


def compare(results: Sequence[LearningCurve], choice: ScoreChoice = LAST_RETURN) -> Comparison:
    """Compare the results of a task by their labels. The first label is the baseline.

    Raises `LareError` if some results are missing, or they are of several tasks.
    """
    groups = group_results(results, choice)
    seed_scores = {group.label: group.seed_scores for group in groups}
    baseline = seed_scores[groups[0].label]
    steps = np.array(groups[0].steps, float)
    thresholds = np.linspace(min(map(np.min, seed_scores.values())), max(map(np.max, seed_scores.values())), 101)
    curves = {group.label: np.moveaxis(group.scores.mean(axis=0), -1, 0) for group in groups}
    return Comparison(
        rows=tuple(_make_row(group, None if group is groups[0] else baseline) for group in groups),
        curves={label: Band(steps, *bootstrap(interquartile_mean, scores)) for label, scores in curves.items()},
        profiles={
            label: Band(thresholds, *bootstrap(lambda sample: performance_profile(sample, thresholds), scores))
            for label, scores in seed_scores.items()
        },
        groups={group.label: group for group in groups},
        choice=choice,
    )


def compare_tasks(results: Sequence[LearningCurve], choice: ScoreChoice = LAST_RETURN) -> list[Comparison]:
    """Compare results on each task, as `compare` does."""
    tasks = sorted({result.task for result in results})
    return [compare([result for result in results if result.task == task], choice) for task in tasks]


def compare_over_tasks(comparisons: Sequence[Comparison]) -> list[OverallRow]:
    """Compare methods with the baseline over the tasks of several comparisons.

    Runs are compared with runs on the same task by their order alone, so the tasks need no common scale. Each task has the same
    weight. A method has a row if it ran on every task with the same number of seeds. There are no rows for a single comparison, if the
    baselines differ, or if fewer than the baseline and one other method qualify.
    """
    if len(comparisons) < 2:
        return []
    seed_scores: dict[str, Scores] = {}
    for label in comparisons[0].groups:
        groups = [comparison.groups[label] for comparison in comparisons if label in comparison.groups]
        if len(groups) == len(comparisons) and len({len(group.seeds) for group in groups}) == 1:
            seed_scores[label] = np.concatenate([group.seed_scores for group in groups], axis=1)
    baselines = {comparison.rows[0].label for comparison in comparisons}
    if len(baselines) > 1 or not seed_scores.keys() > baselines:
        return []
    (baseline,) = baselines
    return [
        OverallRow(label, len(scores), *_improvement(scores, None if label == baseline else seed_scores[baseline]))
        for label, scores in seed_scores.items()
    ]


def _make_row(group: LabelScores, baseline: Scores | None) -> Row:
    scores = group.seed_scores
    improvement, p_value = _improvement(scores, baseline)
    draw_mean = difference = None
    if len(group.draws) > 1:
        draw_mean = estimate(lambda samples: samples.mean(axis=(-2, -1)), group.final_scores.mean(axis=1))
    if baseline is not None and improvement is not None:
        difference = estimate(lambda a, b: interquartile_mean(a) - interquartile_mean(b), scores, baseline)
    return Row(
        label=group.label,
        n_seeds=len(group.seeds),
        n_draws=len(group.draws),
        iqm=estimate(interquartile_mean, scores),
        mean=float(scores.mean()),
        std=sample_std(scores[:, 0]) if len(scores) > 1 else None,
        draw_mean=draw_mean,
        difference=difference,
        probability_of_improvement=improvement,
        p_value=p_value,
    )


def _improvement(scores: Scores, baseline: OtherScores | None) -> tuple[Estimate | None, float | None]:
    """Return `Row.probability_of_improvement` and `Row.p_value`."""
    if baseline is None or min(len(scores), len(baseline)) < 2:
        return None, None
    improvement = estimate(probability_of_improvement, scores, baseline)
    return improvement, two_sided_p(list(zip(scores.T, baseline.T, strict=True)))
