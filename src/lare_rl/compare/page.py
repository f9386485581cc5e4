"""The page of a comparison: its tables, and the figures that Agarwal et al. (2021) recommend."""

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

from lare_rl.compare.bootstrap import REPETITIONS, Estimate
from lare_rl.compare.comparison import Comparison, OverallRow, compare_over_tasks, compare_tasks
from lare_rl.compare.labels import ORIGINS
from lare_rl.compare.messages import MESSAGES, find_min_p, find_score_meaning, find_small_samples, to_text
from lare_rl.compare.results import LearningCurve
from lare_rl.compare.scores import LAST_RETURN, ScoreChoice
from lare_rl.report import figures
from lare_rl.report.html import render_note, render_table, write_page
from lare_rl.runs.metric_names import RETURN
from lare_rl.util.findings import Finding, render
from lare_rl.util.statistics import format_plus_minus

__all__ = ["OVERALL_HEADER", "comparison_table", "describe", "write_comparisons"]

HEADER = ("method", "seeds", "IQM [95%]", "mean ± sd", "minus baseline [95%]", "above baseline [95%]", "p")
DRAWS_HEADER = ("draws", "mean [95%], draws")
OVERALL_HEADER = ("all tasks", "seeds", "above baseline [95%]", "p")


def write_comparisons(
    results: Sequence[LearningCurve],
    out: Path,
    choice: ScoreChoice = LAST_RETURN,
    findings: Iterable[Finding] = (),
) -> tuple[list[Comparison], list[tuple[str, ...]]]:
    """Compare results (`compare_tasks`), and write the page, with the findings about the results at its end.

    Returns:
        The comparisons, and the rows of the table over all tasks, under `OVERALL_HEADER`; no rows if `compare_over_tasks` has none.

    Raises `LareError` if the results cannot be compared, or the file cannot be written.
    """
    comparisons = compare_tasks(results, choice)
    overall = [
        (*_first_cells(row, number), *map(_format_cell, (row.probability_of_improvement, row.p_value)))
        for number, row in enumerate(compare_over_tasks(comparisons))
    ]
    tasks = ", ".join(comparison.task for comparison in comparisons)
    n_labels = len({result.label for result in results})
    title = f"{tasks}: {n_labels} method{'s' if n_labels > 1 else ''}"
    notes = [f"Note: {render(finding, MESSAGES)}" for finding in findings]
    if provenance := _find_provenance(results):
        notes.append(render(provenance, MESSAGES))
    body = [f"<h1>{escape(title)}</h1>", *_body(comparisons, overall), *map(render_note, notes)]
    write_page(out, title, "\n".join(body))
    return comparisons, overall


def describe(comparison: Comparison) -> str:
    """Return a paragraph: what the scores are, and which intervals and p-values so few runs make unreliable."""
    return to_text([find_score_meaning(comparison), *find_small_samples(comparison), *find_min_p(comparison)])


def comparison_table(comparison: Comparison) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the header and the rows of the table. It has columns for draws if a method has several."""
    several_draws = any(row.n_draws > 1 for row in comparison.rows)
    rows = [
        (
            *_first_cells(row, number),
            str(row.iqm),
            format_plus_minus(row.mean, row.std),
            *map(_format_cell, (row.difference, row.probability_of_improvement, row.p_value)),
            *((str(row.n_draws), _format_cell(row.draw_mean)) if several_draws else ()),
        )
        for number, row in enumerate(comparison.rows)
    ]
    return (*HEADER, *DRAWS_HEADER) if several_draws else HEADER, rows


def _first_cells(row: OverallRow, number: int) -> tuple[str, str]:
    """Return the method, with a remark in the first row, and the number of its seeds."""
    return row.label if number else f"{row.label} (baseline)", str(row.n_seeds)


def _format_cell(value: Estimate | float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, Estimate) else f"{value:.2g}"


def _find_provenance(results: Sequence[LearningCurve]) -> Finding | None:
    """Return the versions, machine and evaluations that all runs share."""
    configs = [result.config for result in results if result.config is not None]
    values = {name: {get_value(config) for config in configs} for name, get_value in ORIGINS.items()}
    values["episodes of an evaluation"] = {str(config.settings.evaluation_episodes) for config in configs}
    facts = tuple(f"{name} {group.pop()}" for name, group in values.items() if len(group) == 1)
    return Finding("origin", {"facts": facts}) if facts else None


def _body(comparisons: Sequence[Comparison], overall: Sequence[tuple[str, ...]]) -> Iterator[str]:
    level = 2 if len(comparisons) == 1 else 3
    for comparison in comparisons:
        if len(comparisons) > 1:
            yield f"<h2>{escape(comparison.task)}</h2>"
        header, rows = comparison_table(comparison)
        yield render_table(header, rows, range(1, len(header)))
        yield render_note(describe(comparison))
        score = "true return" if comparison.choice.metric == RETURN else comparison.choice.metric
        yield f"<h{level}>Learning</h{level}>"
        yield figures.draw_bands(comparison.curves, "environment steps", f"IQM of the {score}", x_is_steps=True)
        yield render_note(MESSAGES["curves"])
        yield f"<h{level}>Performance profiles</h{level}>"
        yield figures.draw_bands(comparison.profiles, f"x ({score})", "share of runs that score more")
    if overall:
        yield "<h2>All tasks</h2>"
        yield render_table(OVERALL_HEADER, overall, range(1, len(OVERALL_HEADER)))
        yield render_note(MESSAGES["over_tasks"])
    elif len(comparisons) > 1:
        yield render_note(MESSAGES["no_overall_table"])
    yield render_note(to_text([Finding("columns"), Finding("intervals", {"repetitions": REPETITIONS})]))
