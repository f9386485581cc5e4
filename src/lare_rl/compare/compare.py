"""A comparison of methods as a page: the table, and the figures that rliable's authors recommend."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

from lare_rl.compare.own_results import read_results
from lare_rl.compare.scores import REFERENCES, RETURN, SUMMED_RETURN, Measured, by_label, differing
from lare_rl.compare.statistics import REPETITIONS, Comparison, Estimate, compare, over_all, plus_minus, too_few
from lare_rl.errors import LareError, did_you_mean
from lare_rl.report import figures
from lare_rl.report.html import note, table, write_page
from lare_rl.runs.directory import Config, Run, read_measured
from lare_rl.runs.discover import run_directories

HEAD = ("method", "seeds", "IQM [95%]", "mean ± sd", "minus baseline [95%]", "above baseline [95%]", "p")
OF_DRAWS = ("draws", "mean [95%], draws")
HEAD_OF_ALL = ("all tasks", "seeds", "above baseline [95%]", "p")


def find_all(places: Sequence[Path], metric: str) -> tuple[dict[str, list[Run | Measured]], list[str]]:
    """The runs and tables of results by label, in the order of the places, and remarks for the user.

    Raises:
        LareError: there is nothing to compare, or a table cannot be read.
    """
    tables = [place for place in places if place.suffix == ".csv"]
    directories = [place for place in places if place not in tables]
    runs, remarks = [], []
    if directories or not tables:
        runs, remarks = comparable([read_measured(one) for one in run_directories(directories)], metric)
    found: dict[str, list[Run | Measured]] = {label: list(of_label) for label, of_label in by_label(runs).items()}
    of_tables = [read_results(place, metric) for place in tables]
    if of_runs := {run.config.task.name for run in runs}:
        remarks += tasks_left_out(of_tables, of_runs)
        of_tables = [
            {label: kept for label, some in of_table.items() if (kept := [one for one in some if one.task in of_runs])}
            for of_table in of_tables
        ]
    for label, of_label in (item for of_table in of_tables for item in of_table.items()):
        found.setdefault(label, []).extend(of_label)
    if tables and places[0] == tables[0] and of_tables[0]:  # its first method is the baseline
        first = next(iter(of_tables[0]))
        found = {first: found.pop(first), **found}
    if of_tables:
        remarks += other_ends(runs, of_tables, metric)
    if len(found) > 1 and (names := differing(runs)):
        remarks.append(f"the runs also differ in {', '.join(names)}")
    return found, remarks + several_origins(runs)


ORIGINS: tuple[tuple[str, str, Callable[[Config], str]], ...] = (
    ("by several versions of LaRe", "LaRe {}", lambda config: config.lare),
    ("with several versions of JAX", "JAX {}", lambda config: config.versions["jax"]),
    ("on several machines", "{}", lambda config: config.machine),
)
"""What may differ in the origins of runs: the remark if it does, how it is named if it does not, and its value."""


def several_origins(runs: Sequence[Run]) -> list[str]:
    """Remarks if runs were trained by several versions, or on several machines, with the methods of each."""
    remarks = []
    for what, _, of_config in ORIGINS:
        methods: dict[str, dict[str, None]] = {}
        for run in runs:
            methods.setdefault(of_config(run.config), {})[run.config.settings.method] = None
        if len(methods) > 1:
            told = "; ".join(f"{one}: {', '.join(names)}" for one, names in methods.items())
            remarks.append(f"the runs were trained {what} ({told})")
    return remarks


Tables = Sequence[Mapping[str, Sequence[Measured]]]
"""Results of other programs, by file and by label."""


def tasks_left_out(tables: Tables, of_runs: Collection[str]) -> list[str]:
    """Remarks on tasks that are in tables, and that no run has."""
    every = [one for of_table in tables for of_label in of_table.values() for one in of_label]
    found = dict.fromkeys((one.source, one.task) for one in every if one.task not in of_runs)
    return [
        f"{source} has the task {task}, which is left out: the runs have {', '.join(sorted(of_runs))}"
        for source, task in found
    ]


def other_ends(runs: Sequence[Run], tables: Tables, metric: str) -> list[str]:
    """Remarks on tables that lack the last step of the runs."""
    last: dict[str, int] = {}  # of the shortest run of each task
    for run in runs:
        name, step = run.config.task.name, run.metrics()[-1]["step"]
        last[name] = min(step, last.get(name, step))
    said = []
    of_methods = [item for of_table in tables for item in of_table.items()]
    for method, one in ((method, one) for method, of_method in of_methods for one in of_method):
        if one.task in last and any(last[one.task] not in values for values in one.curves.values()):
            said.append(
                f"{one.source} has no {metric} of {method} at step {last[one.task]:,} for every seed: no run is compared there"
            )
    return said


def comparable(runs: Sequence[Run], metric: str = RETURN) -> tuple[list[Run], list[str]]:
    """The runs that have the metric, and remarks on the metric and on runs that were not trained to their end.

    Raises:
        LareError: no run has an evaluation, or none has a value of the metric.
    """
    found, without, remarks, summed = [], [], [], False
    for run in runs:
        if not (lines := run.metrics()):
            remarks.append(f"{run.directory} has no evaluation yet, and is left out")
            continue
        (found if any(line.get(metric) is not None for line in lines) else without).append(run)
        summed = summed or any(SUMMED_RETURN in line for line in lines)
        if (reached := lines[-1]["step"]) < run.config.settings.steps:
            remarks.append(
                f"{run.directory} has only reached step {reached:,} of {run.config.settings.steps:,}, so no run is compared at a "
                "later step"
            )
        if warning := run.untrained:
            remarks.append(f"{run.directory}: {warning}")
    if not found + without:
        raise LareError(f"{', '.join(str(run.directory) for run in runs)}: no run has an evaluation yet")
    if not found:
        known = {name: value for run in without for line in run.metrics() for name, value in line.items()}
        if metric in known:
            raise LareError(f"no run has a value of {metric} yet: it is null in all of their evaluations")
        names = sorted(known.keys() - {"step", "seed"})
        raise LareError(f"no run has the metric {metric!r}{did_you_mean(metric, names)}; they have {', '.join(names)}")
    remarks += [f"{run.directory} has no {metric}, and is left out" for run in without]
    if summed and metric == RETURN:
        remarks.append(f"returns are means over the agents; --metric {SUMMED_RETURN} compares their sums")
    return found, remarks


def cells(comparison: Comparison) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """The head of the table and its rows, as text. It has columns for draws if a method has several."""
    draws = any(row.draws > 1 for row in comparison.rows)
    rows = [
        (
            named(row.label, place),
            str(row.seeds),
            str(row.iqm),
            plus_minus(row.mean, row.deviation),
            *shown(row.difference, row.better, row.p),
            *((str(row.draws), shown(row.over_draws)[0]) if draws else ()),
        )
        for place, row in enumerate(comparison.rows)
    ]
    return (*HEAD, *OF_DRAWS) if draws else HEAD, rows


def cells_of_all(found: Sequence[Comparison]) -> list[tuple[str, ...]]:
    """The table over all tasks of several comparisons, as text; without rows if there is nothing to compare."""
    return [
        (named(row.label, place), str(row.seeds), *shown(row.better, row.p))
        for place, row in enumerate(over_all(found))
    ]


def named(label: str, place: int) -> str:
    return label if place else f"{label} (baseline)"


def shown(*found: Estimate | float | None) -> tuple[str, ...]:
    """Estimates and probabilities as text. A value that is not known is "-"."""
    return tuple("-" if one is None else f"{one:.2g}" if isinstance(one, float) else str(one) for one in found)


def what_scores_are(comparison: Comparison) -> str:
    """What the scores are, in a sentence or two."""
    steps = f"{int(comparison.curves[comparison.rows[0].label].x[-1]):,}"
    last = "" if comparison.step else ", the last at which all runs were evaluated"
    late = f"averaged over the evaluations after three quarters of {steps} steps"
    when = late if comparison.late else f"at step {steps}{last}"
    what = "true returns" if comparison.metric == RETURN else comparison.metric
    if not comparison.normalised:
        return f"Scores are {what} on {comparison.tasks[0]} {when}."
    ends = (f"{task}: 0 is {REFERENCES[task][0]:g}, 1 is {REFERENCES[task][1]:g}" for task in comparison.tasks)
    return f"Scores are true returns {when}, scaled linearly between two fixed returns. {'; '.join(ends)}."


def smallest_p(comparison: Comparison) -> str:
    """The smallest p that so few runs can have, in a sentence; empty if it is at most 2.5%, or if no p is given."""
    seeds = [row.seeds for row in comparison.rows]
    ways = [
        math.comb(seeds[0] + one, one) for one, row in zip(seeds, comparison.rows, strict=True) if row.p is not None
    ]
    if not ways or (least := 1 / max(ways) ** len(comparison.tasks)) <= 0.025:
        return ""
    return f"With so few runs, p is at least {least:.2g}."


def said_of(comparison: Comparison) -> str:
    """What scores are, and what so few runs cannot tell."""
    return " ".join(filter(None, (what_scores_are(comparison), too_few(comparison), smallest_p(comparison))))


MEANINGS = (
    "IQM: interquartile mean over seeds and tasks; of fewer than four scores it is the mean. sd: standard deviation over the "
    "seeds (n - 1). Minus baseline: the IQM minus that of the baseline, the first method; of two or three seeds its interval is "
    "too narrow. Above baseline: the probability that a run scores more than one of the baseline; one that is 0 or 1 on every "
    "task has no interval. Neither is given for a single seed. If the score is an error or a loss, a low probability is good. p: "
    "the probability of at least so many won pairs of runs by chance or, if fewer than half were won, of so many lost ones (exact "
    "Mann-Whitney test, one-sided: a two-sided p is twice as large). If a method has several draws of the language model, the "
    "mean over the draws of a seed counts as one run."
)


def write_comparisons(
    runs: Mapping[str, Sequence[Run | Measured]],
    out: Path,
    metric: str = RETURN,
    remarks: Sequence[str] = (),
    step: int | None = None,
    late: bool = False,
) -> list[Comparison]:
    """Compare runs by their labels (`compare`), and write the page, with remarks on the runs at its end.

    Raises:
        LareError: the runs cannot be compared, or the file cannot be written.
    """
    found = comparisons(runs, metric, step, late)
    title = f"{', '.join(task for one in found for task in one.tasks)}: {len(runs)} contenders"
    notes = [*(f"Note: {remark}." for remark in remarks), *origin([one for some in runs.values() for one in some])]
    write_page(out, title, "\n".join([*body(title, found), *map(note, notes)]))
    return found


def origin(every: Sequence[Run | Measured]) -> list[str]:
    """What all runs have in common of their versions, machines and evaluations, in a sentence; remarks tell where they differ."""
    configs = [one.config for one in every if isinstance(one, Run)]
    facts = [{name.format(of_config(config)) for config in configs} for _, name, of_config in ORIGINS]
    facts.append({f"{config.settings.evaluation_episodes} episodes in each evaluation" for config in configs})
    told = [one for fact in facts if len(fact) == 1 for one in fact]
    return [f"Runs: {', '.join(told)}."] if told else []


def comparisons(
    runs: Mapping[str, Sequence[Run | Measured]], metric: str = RETURN, step: int | None = None, late: bool = False
) -> list[Comparison]:
    """One comparison over all tasks; one of each task if their scores have no common scale."""
    by_task: dict[str, dict[str, list[Run | Measured]]] = {}
    for label, of_label in runs.items():
        for one in of_label:
            by_task.setdefault(task_of(one), {}).setdefault(label, []).append(one)
    if len(by_task) == 1 or (metric == RETURN and all(task in REFERENCES for task in by_task)):
        return [compare(runs, metric, step, late)]
    return [compare(by_task[task], metric, step, late) for task in sorted(by_task)]


def task_of(one: Run | Measured) -> str:
    return one.task if isinstance(one, Measured) else one.config.task.name


def body(title: str, found: Sequence[Comparison]) -> Iterable[str]:
    level = 2 if len(found) == 1 else 3
    yield f"<h1>{escape(title)}</h1>"
    for comparison in found:
        if len(found) > 1:
            yield f"<h2>{escape(comparison.tasks[0])}</h2>"
        head, rows = cells(comparison)
        yield table(head, rows, range(1, len(head)))
        yield note(said_of(comparison))
        score = (
            "score" if comparison.normalised else "true return" if comparison.metric == RETURN else comparison.metric
        )
        yield f"<h{level}>Learning</h{level}>"
        yield figures.bands(comparison.curves, "environment steps", f"IQM of the {score}", True)
        yield note("Lines: IQM over the seeds. Bands: its 95% intervals.")
        yield f"<h{level}>Performance profiles</h{level}>"
        yield figures.bands(comparison.profiles, f"x ({score})", "share of runs that score more", False)
    if rows := cells_of_all(found):
        yield "<h2>All tasks</h2>"
        yield table(HEAD_OF_ALL, rows, range(1, len(HEAD_OF_ALL)))
    yield note(
        f"{MEANINGS} Intervals: stratified bootstrap over the seeds, {REPETITIONS} repetitions; in the column with draws, over the "
        "draws of the language model."
    )
