"""The sections of a report that stand first: the verdict on a run, learning curves, and final values."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lare_rl.report.charts import N_COLOURS, Chart, Line, draw_legend
from lare_rl.report.diagnosis import diagnose
from lare_rl.report.html import render_figures, render_fold, render_note, render_table, render_tiles
from lare_rl.report.messages import MESSAGES, WORDS
from lare_rl.report.reported_run import Curve, ReportedRun, finite, mean_over_seeds
from lare_rl.report.run_summary import EpisodicRun, RunSummary, summarise_run
from lare_rl.runs.metric_names import CREDIT_CORRELATION, CREDIT_ERROR, RETURN, RETURN_R2, RETURN_STD
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.findings import Finding, format_for_reader, format_number, render
from lare_rl.util.statistics import format_mean_std

__all__ = [
    "render_final_values",
    "render_headline",
    "render_learning_curves",
    "render_trust",
    "render_verdict",
    "render_words",
    "sort_runs",
    "summarise_runs",
]

MAX_HOVER_LINES = 10
"""The largest number of lines of a text that appears at a step: the step, and a value of each run."""
_METRICS = {
    RETURN: WORDS["return"][0],
    RETURN_R2: WORDS["r2"][0],
    CREDIT_CORRELATION: WORDS["correlation"][0],
    CREDIT_ERROR: WORDS["error"][0],
}
"""The metrics in tables of final values, with their titles."""


class _Metric(NamedTuple):
    """A metric that is drawn over the steps."""

    name: str
    title: str
    limits: tuple[float, float] | None = None
    """The ends of the axis. They become -1 and 1 if a value is negative."""
    std_name: str = ""
    """The metric of its standard deviation over the episodes of an evaluation, if there is one."""


def summarise_runs(
    runs: Sequence[ReportedRun], random_returns: Float[np.ndarray, "teams episodes"]
) -> list[RunSummary | None]:
    """Return the summary of each run of a task, with the returns of its first team.

    Each run is compared with the best episodic run. Episodic runs are compared with none.
    """
    episodic = None
    episodic_runs = [run for run in runs if run.is_episodic and np.isfinite(run.final_return)]
    if episodic_runs:
        best = sort_runs(episodic_runs)[0]
        summary = summarise_run(best, random_returns[0], None)
        assert summary is not None
        name = best.name if len(episodic_runs) > 1 else None
        episodic = EpisodicRun(summary.final_return, len(summary.final_returns), name, summary.final_error)
    return [summarise_run(run, random_returns[0], None if run.is_episodic else episodic) for run in runs]


def render_verdict(
    reported: ReportedRun, summary: RunSummary | None, film: str = "", has_title: bool = True
) -> Iterable[str]:
    """Yield what a run reached: a film, a verdict and numbers."""
    yield f'<div class="hero{" filmed" if film else ""}">{film}<div>'
    if has_title:
        yield f"<h1>{escape(reported.name)} on {escape(reported.run.config.task.name)}</h1>"
    if summary is None:
        yield f'<p class="headline">{MESSAGES["no_evaluation"]}</p></div></div>'
        return
    yield f'<p class="headline">{escape(render_headline(summary))}</p>'
    if len(reported.run.config.task.teams) > 1:
        yield render_note(f"Sentences and numbers are about the first team, {reported.run.config.task.roles[0].name}.")
    for subject, finding in diagnose(summary):
        if subject != "credit":
            class_ = ' class="verdict"' if subject == "next" else ""
            yield f"<p{class_}>{render(finding, MESSAGES, 'html')}</p>"
    yield f"{render_tiles(_tiles(reported, summary))}</div></div>"


def _tiles(reported: ReportedRun, summary: RunSummary) -> Iterable[tuple[str, str, str]]:
    """Yield the numbers of a run: title, number, remark. Those that are unknown are missing."""
    returns = summary.final_returns
    for title, values, noun in ("Return", returns, "seed"), ("Random actions", summary.random_returns, "episode"):
        number, _, std = _format_spread(values).partition(" ± ")
        if number:
            yield title, number, f"{std and f'± {std}, '}{format_for_reader(len(values), f'count {noun}')}"
    if summary.return_r2 is not None:
        yield WORDS["r2"][0], format_for_reader(summary.return_r2, "r2"), "of new episodes; 1 is perfect"
    if (seconds := reported.training_seconds()) is not None:
        yield "Time trained", format_for_reader(seconds, "seconds"), f"{int(summary.steps[-1]):,} steps for each seed"


def render_headline(summary: RunSummary) -> str:
    """Return the verdict in a few words, as text."""
    _, finding = diagnose(summary)[0]
    return render(Finding(f"headline_{finding.code}", finding.values), MESSAGES)


def render_trust(summary: RunSummary | None) -> Iterable[str]:
    """Yield the findings about the quality of a run's credit."""
    for subject, finding in [] if summary is None else diagnose(summary):
        if subject == "credit":
            yield f"<p>{render(finding, MESSAGES, 'html')}</p>"


def sort_runs(runs: Iterable[ReportedRun]) -> list[ReportedRun]:
    """Sort runs by their final returns, the best first."""
    return sorted(runs, key=lambda reported: reported.final_return, reverse=True)


def render_final_values(runs: Sequence[ReportedRun]) -> str:
    """Return a table of the last values of runs of a task: a row for each run or, of a single run, for each seed."""
    rows = []
    for reported in runs:
        step, n_seeds = f"{reported.last_step:,}", len(reported.run.seeds)
        if len(runs) > 1:
            values = [reported.final_values(metric) for metric in _METRICS]
            rows.append((reported.name, *map(_format_spread, values), str(n_seeds), step))
        else:
            columns = [reported.values(metric)[:, -1:] for metric in _METRICS]
            for i, seed in enumerate(reported.run.seeds):
                rows.append((f"seed {seed}", *(_format_spread(finite(column[i])) for column in columns), "", step))
    header = ("run", *_METRICS.values(), "seeds", "steps")
    return render_table(header, rows, numbers=range(1, len(header)))


def render_learning_curves(
    task: TaskSpec, runs: Sequence[ReportedRun], random_returns: Float[np.ndarray, "teams episodes"]
) -> Iterable[str]:
    """Yield the curve of the return of each team, and the curves of the other metrics folded below it."""
    colours = {reported.name: f"c{i}" if i < N_COLOURS else "grey" for i, reported in enumerate(sort_runs(runs))}
    random_means = [float(returns.mean()) if len(returns) else None for returns in random_returns]
    warmups = {reported.run.config.settings.warmup for reported in runs}
    warmup = warmups.pop() if len(warmups) == 1 else 0
    n_episodes = sorted({reported.run.config.settings.evaluation_episodes for reported in runs})
    yield render_note(
        f"A point is the mean of an evaluation of {' or '.join(map(str, n_episodes))} episodes. To quote a final return, play more: "
        "lare-rl evaluate RUN --episodes 100."
    )
    yield _render_legend(runs, colours, random_means[0] is not None, warmup)
    returns = _for_teams([_Metric(RETURN, "True return", std_name=RETURN_STD)], task)
    for metric, random_mean in zip(returns, random_means, strict=True):
        if chart := _draw_metric(metric, runs, colours, warmup, random_mean):
            yield render_note(metric.title) + chart
    charts = {
        metric.title: chart
        for metric in _other_metrics(task)
        if (chart := _draw_metric(metric, runs, colours, warmup, label_gap=9.0))
    }
    yield render_fold("More curves", [render_figures(charts)])


def _other_metrics(task: TaskSpec) -> Iterable[_Metric]:
    measures = [_Metric(f"evaluation/{name}", name.replace("_", " ").capitalize()) for name in task.measures]
    metrics = [
        _Metric(RETURN_R2, WORDS["r2"][0], (0.0, 1.0)),
        _Metric(CREDIT_CORRELATION, "Correlation of proxy and true rewards", (0.0, 1.0)),
        _Metric(CREDIT_ERROR, "Credit error: mean |proxy - true reward|"),
    ]
    return [*measures, *_for_teams(metrics, task)]


def _for_teams(metrics: Sequence[_Metric], task: TaskSpec) -> Sequence[_Metric]:
    """Return the metrics of each team. Those of a task with fewer than two teams are unchanged."""
    if len(task.teams) < 2:
        return metrics
    return [
        _Metric(f"{name}_{team}", f"{title}, team of {team}", limits, std_name and f"{std_name}_{team}")
        for name, title, limits, std_name in metrics
        for team in (role.team for role in task.teams)
    ]


def _draw_metric(
    metric: _Metric,
    runs: Sequence[ReportedRun],
    colours: dict[str, str],
    warmup: int,
    random_mean: float | None = None,
    label_gap: float = Chart.label_gap,
) -> str:
    """Draw a metric of all runs: the mean over seeds and, of few runs, each seed. Return an empty text if no run has it."""
    curves = {reported.name: curve for reported in runs if (curve := reported.curve(metric.name))}
    if not curves:
        return ""
    lines, n_coloured = [], sum(colour != "grey" for colour in colours.values())
    stds = {reported.name: reported.curve(metric.std_name) for reported in runs}
    for name in sorted(curves, key=lambda name: colours[name] == "grey"):
        (steps, values), colour = curves[name], colours[name]
        if len(values) > 1 and len(runs) <= N_COLOURS:
            lines += [Line(steps, row, f"{colour} thin") for row in values]
        std = stds[name] if len(values) == 1 and n_coloured == 1 else None
        label = name if len(runs) > 1 and (colour != "grey" or len(runs) <= 2 * N_COLOURS) else ""
        style = "grey faint" if colour == "grey" else colour
        band = None if std is None else std[1][0]
        lines.append(Line(steps, mean_over_seeds(values), style, label=label, band=band))
    all_steps = np.concatenate([steps for steps, _ in curves.values()])
    extent = np.array([all_steps.min() if np.ptp(all_steps) else 0.0, all_steps.max()])
    if random_mean is not None:
        lines.append(Line(extent, np.full(2, random_mean), "grey dashed", label=WORDS["random"][0]))
    has_negative = any((finite(line.y) < 0).any() for line in lines)
    limits = (-1.0, 1.0) if metric.limits and has_negative else metric.limits
    final = ", ".join(f"{name} {_format_spread(finite(values[:, -1]))}" for name, (_, values) in curves.items())
    return Chart(
        lines=lines,
        description=f"{metric.title} over environment steps. Last values: {final}",
        x_label="environment steps",
        limits=limits,
        hovers=_hovers(curves),
        shaded_until=float(warmup),
        label_gap=label_gap,
    ).render()


def _hovers(curves: dict[str, Curve]) -> dict[float, str]:
    """Return the values at each step, as texts."""
    texts: dict[float, list[str]] = {}
    for name, (steps, values) in curves.items():
        for step, column in zip(steps, values.T, strict=True):
            seeds = (
                f" ({', '.join(format_number(x) if np.isfinite(x) else '-' for x in column)})"
                if len(curves) == 1 and len(column) > 1
                else ""
            )
            if len(numbers := finite(column)):
                lines = texts.setdefault(float(step), [f"step {step:,.0f}"])
                lines.append(f"{name}: {format_number(numbers.mean())}{seeds}")
    return {step: "\n".join(lines[:MAX_HOVER_LINES]) for step, lines in sorted(texts.items())}


def _render_legend(runs: Sequence[ReportedRun], colours: dict[str, str], has_random_mean: bool, warmup: int) -> str:
    """Return the meaning of lines, once for all charts."""
    n_seeds = max(len(reported.run.seeds) for reported in runs)
    entries = [(colour, name) for name, colour in colours.items() if colour != "grey"]
    if n_grey := len(colours) - len(entries):
        entries.append(("grey faint", f"{n_grey} with lower returns"))
    if n_seeds > 1 and len(runs) <= N_COLOURS:
        entries.append(("c0 thin" if len(runs) == 1 else "grey thin", "a seed"))
    if n_seeds == 1 and len(entries) == 1:
        entries.append(("band c0", "± deviation over the episodes of an evaluation"))
    if has_random_mean:
        entries.append(("grey dashed", WORDS["random"][0]))
    if warmup:
        entries.append(("shade", "random steps before the first update"))
    return draw_legend(entries)


def render_words() -> str:
    """Return the explanations of words, to which links lead."""
    items = (f'<dt id="{code}">{escape(title)}</dt><dd>{escape(text)}</dd>' for code, (title, text) in WORDS.items())
    return f'<h2>Words</h2><dl class="words">{"".join(items)}</dl>'


def _format_spread(values: Float[np.ndarray, " values"]) -> str:
    """Write the mean of some values ± their standard deviation, or nothing without values."""
    return format_mean_std(values) if len(values) else ""
