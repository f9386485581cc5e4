"""The report: one self-contained HTML file on one run, or on several runs whose curves are drawn in the same charts."""

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.evaluation.evaluate import measure_random_returns
from lare_rl.evaluation.video import record_video
from lare_rl.report.html import render_note, write_page
from lare_rl.report.overview import render_diagnoses, render_final_values, render_learning_curves
from lare_rl.report.run_details import FILM, render_run
from lare_rl.report.run_summary import ReportedRun
from lare_rl.runs.directory import Run, find_run_directories, open_run, open_without_functions
from lare_rl.tasks.trust import untrusted_module
from lare_rl.util.provenance import code_version

__all__ = ["write_report"]

MAX_TITLE_RUNS = 3
"""The largest number of runs that the title names."""


def write_report(
    runs: Run | str | Path | Iterable[Run | str | Path], out: str | Path | None = None, film: bool = False
) -> Path:
    """Write the report of one or more runs, and return its path.

    Args:
        runs: one run or several, or their directories; finished or not.
        out: the file; the default is report.html in the first run's directory.
        film: film an episode of each run, as `film.gif` in its directory. The page shows every film that exists.

    Raises:
        LareError: a directory has no run, a run has no evaluation yet, or the file cannot be written.
    """
    sources = [runs] if isinstance(runs, (Run, str, Path)) else list(runs)
    if not sources:
        raise LareError("No runs to report. Name one run or more.")
    opened: list[Run] = []
    for source in sources:
        opened += [source] if isinstance(source, Run) else map(_open_run, find_run_directories([Path(source)]))
    reported_runs = _name_runs(opened)
    for reported in reported_runs:
        if not reported.metrics:
            raise LareError(f"{reported.run.directory} has no evaluation yet: there is nothing to report")
    path = Path(out) if out is not None else reported_runs[0].run.directory / "report.html"
    if not path.parent.is_dir():
        raise LareError(f"the report {path} cannot be written: there is no folder {path.parent}")
    if film:
        for reported in reported_runs:
            record_video(reported.run, reported.run.directory / FILM)
    title = _title(reported_runs)
    return write_page(path, title, "\n".join(_render_body(title, reported_runs)))


def _open_run(directory: Path) -> Run:
    """Open a run, without functions if its environment is in an untrusted module: a report imports no such module."""
    run = open_without_functions(directory)
    return open_run(directory) if untrusted_module(run.config.task) is None else run


def _name_runs(runs: Sequence[Run]) -> list[ReportedRun]:
    """Name each run by its method. Runs of the same method are named by their directories, or by method and directory."""
    methods, names = Counter(run.config.settings.method for run in runs), []
    for run in runs:
        method, directory = run.config.settings.method, run.directory.name
        qualified = directory if directory.startswith(method) else f"{method} ({directory})"
        names.append(method if methods[method] == 1 else qualified)
    counts = Counter(names)
    return [
        ReportedRun(f"{name} #{number}" if counts[name] > 1 else name, run)
        for number, (name, run) in enumerate(zip(names, runs, strict=True), start=1)
    ]


def _title(reported_runs: Sequence[ReportedRun]) -> str:
    tasks = sorted({reported.run.config.task.name for reported in reported_runs})
    few = len(reported_runs) <= MAX_TITLE_RUNS
    names = ", ".join(reported.name for reported in reported_runs) if few else f"{len(reported_runs)} runs"
    return f"{', '.join(tasks)}: {names}"


def _render_body(title: str, reported_runs: Sequence[ReportedRun]) -> list[str]:
    """Return all sections: diagnoses, final values, learning curves, and the details of each run."""
    diagnoses, curves, details = [], [], []
    for task in sorted({reported.run.config.task.name for reported in reported_runs}):
        runs_of_task = [reported for reported in reported_runs if reported.run.config.task.name == task]
        spec = runs_of_task[0].run.config.task
        random_returns = measure_random_returns(spec)
        diagnoses += render_diagnoses(runs_of_task, random_returns)
        curves += render_learning_curves(spec, runs_of_task, random_returns)
    for reported in reported_runs:
        details += render_run(reported.name, reported.run)
    heading, version = f"<h1>{escape(title)}</h1>", render_note(f"Drawn by LaRe {code_version()}.")
    return [heading, *diagnoses, render_final_values(reported_runs), *curves, *details, version]
