"""Collects the results of a comparison from run directories and tables, and finds what is wrong with them."""

from collections.abc import Sequence
from pathlib import Path

from lare_rl.compare.labels import find_differences, find_origin_differences, label_runs
from lare_rl.compare.metric_tables import is_sweep_table
from lare_rl.compare.results import LearningCurve, group_pairs, read_results_table, read_run_results
from lare_rl.errors import LareError, did_you_mean
from lare_rl.runs.directory import Run, find_run_directories, is_output, open_without_functions
from lare_rl.runs.metric_names import RETURN, SUMMED_RETURN
from lare_rl.training.advice import describe_untrained
from lare_rl.util.findings import Finding

__all__ = ["collect_results", "select_runs"]


def collect_results(paths: Sequence[Path], metric: str = RETURN) -> tuple[list[LearningCurve], list[Finding]]:
    """Read the results in run directories and tables (.csv), and find what the user should know about them.

    The first label is the baseline. If the first path is a table, it is that table's first label that is kept; else, with one directory,
    `episodic`, if it was trained; else that of the first run. All other labels of tables come after those of runs.

    Raises `LareError` if a path has nothing to compare, or a file is damaged.
    """
    tables = [path for path in paths if path.suffix.lower() == ".csv" and not path.is_dir()]
    directories = [path for path in paths if path not in tables and (len(paths) == 1 or not is_output(path))]
    runs, findings = [], []
    if directories or not tables:
        run_directories = find_run_directories(directories)
        runs, findings = select_runs(list(map(open_without_functions, run_directories)), metric)
        # DIRECTORY/* of a sweep has its table, too.
        above = {parent for directory in run_directories for parent in directory.resolve().parents}
        tables = [path for path in tables if path.resolve().parent not in above or not is_sweep_table(path)]
        if len(directories) == 1:  # the user has not chosen a baseline
            runs.sort(key=lambda run: run.config.settings.method != "episodic")
    run_results = read_run_results(label_runs(runs), metric)
    table_results = [result for path in tables for result in read_results_table(path, metric)]
    if run_results:
        tasks = sorted({result.task for result in run_results})
        findings += _find_other_tasks(tasks, table_results)
        table_results = [result for result in table_results if result.task in tasks]
        findings += _find_other_steps(run_results, table_results, metric)
    results = run_results + table_results
    if first := next((result.label for result in table_results if result.source == paths[0]), None):
        results.sort(key=lambda result: result.label != first)
    has_several_labels = len({result.label for result in results}) > 1
    if differences := (find_differences(runs) if has_several_labels else []) + find_origin_differences(runs):
        findings.append(Finding("differ", {"differences": tuple(differences)}))
    return results, findings


def select_runs(runs: Sequence[Run], metric: str = RETURN) -> tuple[list[Run], list[Finding]]:
    """Select the runs that have a metric. Report those left out, unfinished or never updated, and that returns are means over agents.

    Raises `LareError` if no run has an evaluation, or none has a value of the metric.
    """
    selected, without_metric, findings, names = [], [], [], set()
    for run in runs:
        lines, steps = run.metrics(), run.config.settings.steps
        if not lines:
            findings.append(Finding("no_evaluation", {"run": run.directory}))
            continue
        names |= {name for line in lines for name in line}
        if not any(line.get(metric) is not None for line in lines):
            without_metric.append(run)
            continue
        selected.append(run)
        if (step := lines[-1]["step"]) < steps:
            findings.append(Finding("unfinished", {"run": run.directory, "step": step, "steps": steps}))
        if reason := describe_untrained(run):
            findings.append(Finding("untrained", {"run": run.directory, "reason": reason}))
    if not selected:
        if not without_metric:
            raise LareError(f"{', '.join(str(run.directory) for run in runs)}: no run has an evaluation yet")
        if metric in names:
            raise LareError(f"no run has a value of {metric} yet: it is null in all evaluations")
        metrics = sorted(names - {"step", "seed"})
        raise LareError(
            f"no run has the metric {metric!r}{did_you_mean(metric, metrics)}; they have {', '.join(metrics)}"
        )
    findings += [Finding("no_metric", {"run": run.directory, "metric": metric}) for run in without_metric]
    if metric == RETURN and SUMMED_RETURN in names:
        findings.append(Finding("mean_over_agents", {"metric": SUMMED_RETURN}))
    if metric == RETURN:
        teams = {run.config.task.name: run.config.task.roles for run in selected if len(run.config.task.teams) > 1}
        findings += [
            Finding("first_team", {"task": task, "teams": tuple(f"{RETURN}_{role.team}" for role in roles)})
            for task, roles in teams.items()
        ]
    return selected, findings


def _find_other_tasks(tasks: Sequence[str], table_results: Sequence[LearningCurve]) -> list[Finding]:
    """Report the tasks of tables that no run has. `tasks` are those of the runs."""
    unknown = dict.fromkeys((result.source, result.task) for result in table_results if result.task not in tasks)
    return [Finding("other_task", {"source": source, "task": task, "tasks": tuple(tasks)}) for source, task in unknown]


def _find_other_steps(
    run_results: Sequence[LearningCurve], table_results: Sequence[LearningCurve], metric: str
) -> list[Finding]:
    """Report the methods of tables that lack the last step that all runs have."""
    steps_by_task = group_pairs((result.task, set(result.values)) for result in run_results if result.values)
    last_steps = {task: max(set.intersection(*steps), default=None) for task, steps in steps_by_task.items()}
    missing = dict.fromkeys(
        (result.source, result.label, result.task, step)
        for result in table_results
        if (step := last_steps[result.task]) is not None and step not in result.values
    )
    return [
        Finding("other_steps", {"source": source, "metric": metric, "label": label, "task": task, "step": step})
        for source, label, task, step in missing
    ]
