"""The sentences of a comparison: their templates, and the rules that choose them."""

import math
from collections.abc import Iterable, Iterator

from lare_rl.compare.comparison import Comparison
from lare_rl.runs.metric_names import RETURN
from lare_rl.util.findings import Finding, render

__all__ = ["MESSAGES", "find_min_p", "find_score_meaning", "find_small_samples", "to_text"]

MAX_MIN_P = 0.05
"""The reader is warned if p cannot be lower than this."""

MESSAGES = {
    # Runs and tables (`collect.py`).
    "no_evaluation": "{run} is left out: it has no evaluation yet.",
    "no_metric": "{run} is left out: it has no {metric}.",
    "unfinished": "{run} has only reached step {step:,} of {steps:,}: no run of its task is compared at a later step.",
    "untrained": "{run}: {reason}",
    "mean_over_agents": "Returns are means over the agents. --metric {metric} compares their sums.",
    "first_team": "On {task}, returns are those of the first team. --metric takes that of each: {teams}.",
    "other_task": "The rows of {source} on {task} are left out: the runs are on {tasks}.",
    "other_steps": "{source} lacks {metric} of {label} on {task} at step {step:,} for some seeds: no run of {task} is compared there.",
    "differ": "The runs differ in {differences}.",
    "origin": "All runs: {facts}.",
    # Scores.
    "scores": "Scores are {metric} on {task} {when}.",
    "true_returns": "true returns",
    "at_step": "at step {step:,}",
    "at_last_step": "at step {step:,}, the last at which all runs were evaluated",
    "late": "averaged over the evaluations after three quarters of {step:,} steps",
    # Few runs.
    "few_values": "The interval of {count} {noun} is their range, which contains the true median in {coverage:.0%} of cases, not in 95%.",
    "min_p": "With these few runs, p is at least {p:.2g}.",
    # Legends.
    "columns": "IQM: interquartile mean over the seeds; of fewer than four scores it is the mean. sd: standard deviation over "
    "the seeds (n - 1). Minus baseline: the IQM minus the IQM of the baseline, the first method; its interval is too narrow for two or "
    "three seeds. Above baseline: the probability that a run scores more than a run of the baseline; without an interval if it is 0 "
    "or 1. Neither is computed for a single seed. If the score is an error or a loss, a low probability is good. p: "
    "exact two-sided Mann-Whitney test. If a method has several draws of the language model, the mean over the draws of a seed counts "
    "as one run.",
    "intervals": "Intervals: bootstrap over the seeds, {repetitions} repetitions; in the column with draws, over the draws "
    "of the language model.",
    "curves": "Lines: IQM over the seeds. Bands: its 95% intervals.",
    "over_tasks": "All tasks: each run is compared with the runs on the same task.",
    "no_overall_table": "There is no table over all tasks: every task needs the same baseline and another method, with equally many seeds.",
}


def to_text(findings: Iterable[Finding]) -> str:
    """Return findings as one paragraph."""
    return " ".join(render(finding, MESSAGES) for finding in findings)


def find_score_meaning(comparison: Comparison) -> Finding:
    """Return what the scores are, and at which step."""
    choice = comparison.choice
    when = "late" if choice.average_last_quarter else "at_step" if choice.step is not None else "at_last_step"
    metric = Finding("true_returns") if choice.metric == RETURN else choice.metric
    values = {"metric": metric, "task": comparison.task, "when": Finding(when, {"step": comparison.last_step})}
    return Finding("scores", values)


def find_small_samples(comparison: Comparison) -> Iterator[Finding]:
    """Report the intervals that are too narrow.

    The bootstrap's interval of n = 2 or 3 values is their range: one sample in n^n has the lowest value n times, which is more than
    2.5% of the samples. The range contains the median with probability 1 - 2^(1 - n).
    """
    samples = {"seeds": {row.n_seeds for row in comparison.rows}, "draws": {row.n_draws for row in comparison.rows}}
    for noun, counts in samples.items():
        for count in sorted(counts & {2, 3}):
            yield Finding("few_values", {"noun": noun, "count": count, "coverage": 1 - 2.0 ** (1 - count)})


def find_min_p(comparison: Comparison) -> Iterator[Finding]:
    """Report the lowest possible p, if it is not low."""
    n_seeds = comparison.rows[0].n_seeds
    n_splits = [math.comb(n_seeds + row.n_seeds, row.n_seeds) for row in comparison.rows if row.p_value is not None]
    if n_splits and (min_p := 2 / max(n_splits)) > MAX_MIN_P:
        yield Finding("min_p", {"p": min_p})
