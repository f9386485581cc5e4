"""The sections of a report that show several runs together: diagnoses, final values, learning curves."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.evaluation.reference_returns import REFERENCE_RETURNS
from lare_rl.report.diagnosis import diagnose
from lare_rl.report.figures import draw_curves
from lare_rl.report.html import render_note, render_table
from lare_rl.report.messages import MESSAGES
from lare_rl.report.run_summary import ReportedRun, summarise_run
from lare_rl.runs.metric_names import CREDIT_CORRELATION, CREDIT_ERROR, RETURN, RETURN_R2, RETURN_STD
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.findings import render
from lare_rl.util.statistics import format_mean_std

__all__ = ["render_diagnoses", "render_final_values", "render_learning_curves"]


_COLUMNS = {
    RETURN: ("return", "mean true return at the last evaluation."),
    CREDIT_ERROR: ("credit error", "mean |proxy reward - true reward| over the newest steps."),
    CREDIT_CORRELATION: ("correlation", "Pearson's, of proxy and true rewards over the newest steps."),
    RETURN_R2: (
        "R² of returns",
        "how well the last episodes' returns were predicted before anything was fitted to them.",
    ),
}
"""The columns of the table of final values: titles and meanings."""


class _Chart(NamedTuple):
    """A chart of a metric over the steps."""

    metric: str
    title: str
    unit: str
    bottom: float | None = None
    lowest_bottom: float | None = None


def render_diagnoses(runs: Sequence[ReportedRun], random_returns: Float[np.ndarray, " episodes"]) -> Iterable[str]:
    """Yield the diagnosis of each run of a task."""
    episodic_returns = {
        reported.name: float(returns.mean())
        for reported in runs
        if reported.run.config.settings.method == "episodic" and len(returns := reported.final_values(RETURN))
    }
    for reported in runs:
        episodic_return = next((value for name, value in episodic_returns.items() if name != reported.name), None)
        if (summary := summarise_run(reported, random_returns, episodic_return)) is not None:
            sentences = " ".join(render(finding, MESSAGES, "html") for finding in diagnose(summary))
            yield f'<p class="verdict"><strong>{escape(reported.name)}.</strong> {sentences}</p>'


def render_final_values(runs: Sequence[ReportedRun]) -> str:
    """Return a table with a row for each run. It leaves out a metric that no run has."""
    finals = {metric: [reported.final_values(metric) for reported in runs] for metric in _COLUMNS}
    finals = {metric: values for metric, values in finals.items() if any(map(len, values))}
    rows = []
    for row, reported in enumerate(runs):
        run, last_step = reported.run, reported.metrics[-1]["step"]
        cells = [format_mean_std(values[row]) if len(values[row]) else "-" for values in finals.values()]
        rows.append((run.config.task.name, reported.name, str(len(run.seeds)), f"{last_step:,}", *cells))
    header = "task", "method", "seeds", "steps", *(_COLUMNS[metric][0] for metric in finals)
    notes = [f"{title[0].upper()}{title[1:]}: {meaning}" for title, meaning in (_COLUMNS[metric] for metric in finals)]
    if max(len(reported.run.seeds) for reported in runs) > 1:
        notes.append("±: standard deviation over seeds.")
    return render_table(header, rows, numbers=range(2, len(header))) + render_note(" ".join(notes))


def render_learning_curves(
    task: TaskSpec, runs: Sequence[ReportedRun], random_returns: Float[np.ndarray, " episodes"]
) -> Iterable[str]:
    """Yield the charts of one task, with all its runs in each."""
    reference_lines = {"random actions": float(random_returns.mean())} if len(random_returns) else {}
    if (reference := REFERENCE_RETURNS.get(task.name)) is not None:
        best = max((float(np.nanmax(returns)) for _, returns in _curves(runs, RETURN).values()), default=-np.inf)
        if best > (reference.random + reference.trained) / 2:  # the curves of bad runs would look flat below this line
            reference_lines["true rewards, a million steps"] = reference.trained
    warmups = {reported.run.config.settings.warmup for reported in runs}
    warmup = warmups.pop() if len(warmups) == 1 else 0
    yield f"<h2>Learning {escape(task.name)}</h2>"
    yield '<div class="figures">'
    for chart in _charts(task):
        if not (curves := _curves(runs, chart.metric)):
            continue
        is_return = chart.metric == RETURN
        yield f"<figure><figcaption>{escape(chart.title[0].upper() + chart.title[1:])}</figcaption>"
        yield draw_curves(
            curves,
            chart.unit,
            bottom=chart.bottom,
            lowest_bottom=chart.lowest_bottom,
            reference_lines=reference_lines if is_return else None,
            warmup=warmup,
            episode_stds=_curves(runs, RETURN_STD) if is_return else None,
        )
        yield "</figure>"
    yield "</div>"
    yield render_note(" ".join(_explain_charts(task, runs, warmup)))


def _curves(runs: Sequence[ReportedRun], metric: str) -> Mapping:
    curves = {reported.name: reported.curve(metric) for reported in runs}
    return {name: curve for name, curve in curves.items() if curve is not None}


def _charts(task: TaskSpec) -> Iterable[_Chart]:
    """Yield the charts of a task, one for each team if there are several."""
    charts = (
        _Chart(RETURN, "true return", "return"),
        *(
            _Chart(f"evaluation/{measure}", words, words)
            for measure, words in zip(task.measures, (name.replace("_", " ") for name in task.measures), strict=True)
        ),
        _Chart(CREDIT_ERROR, "mean |proxy - true reward|", "reward", bottom=0.0),
        _Chart(CREDIT_CORRELATION, "correlation of proxy and true reward", "correlation"),
        _Chart(RETURN_R2, "R² of returns, predicted before they were learned from", "R²", lowest_bottom=-1.0),
    )
    if not task.teams:
        yield from charts
    for chart in charts:
        for role in task.teams:
            yield chart._replace(metric=f"{chart.metric}_{role.team}", title=f"{chart.title}, team of {role.team}")


def _explain_charts(task: TaskSpec, runs: Sequence[ReportedRun], warmup: int) -> Iterable[str]:
    """Yield what lines and areas mean."""
    seed_counts = [len(reported.run.seeds) for reported in runs]
    if max(seed_counts) > 1:
        single_seed = "; of a single seed, over the episodes of an evaluation" if min(seed_counts) == 1 else ""
        yield f"Line: mean over seeds. Band: ± one standard deviation over seeds{single_seed}."
    else:
        yield "Band of the return: ± one standard deviation over the episodes of an evaluation."
    if warmup:
        yield "Grey area: the first steps, of random actions, before the first update."
    if task.name in REFERENCE_RETURNS:
        best = REFERENCE_RETURNS[task.name].trained
        yield f"The highest published return of TD3 on true rewards within a million steps is about {best:,g}."
