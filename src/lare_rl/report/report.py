"""The report: one self-contained HTML file on one run, or on several runs whose curves are drawn in the same charts."""

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.evaluation.evaluate import evaluation_seeds, measure_random_returns, n_random_episodes
from lare_rl.evaluation.video import encode_film, record_frames
from lare_rl.report.html import render_film, render_fold, render_note, write_page
from lare_rl.report.overview import (
    render_final_values,
    render_headline,
    render_learning_curves,
    render_trust,
    render_verdict,
    render_words,
    sort_runs,
    summarise_runs,
)
from lare_rl.report.reported_run import ReportedRun
from lare_rl.report.run_details import describe_method, render_details, render_settings
from lare_rl.report.run_summary import RunSummary
from lare_rl.runs.checkpoint import STATE_FILE
from lare_rl.runs.directory import Run, as_run, find_run_directories, open_run, open_without_functions
from lare_rl.tasks.spec import check_same_tasks
from lare_rl.tasks.trust import untrusted_module
from lare_rl.util.files import check_new_path, write_bytes
from lare_rl.util.provenance import code_version
from lare_rl.util.rounding import round_up

__all__ = ["default_path", "write_report"]

MAX_TITLE_RUNS = 3
"""The largest number of runs that the title names."""
FILM = "film.webp"
"""The film in a run's directory."""
MAX_FILMS, MAX_FRAMES, FILM_BYTES = 4, 160, 280_000
"""The largest numbers of films of a task and of frames of a film, and of the bytes of all films of a task."""


def write_report(
    runs: Run | str | Path | Iterable[Run | str | Path], out: str | Path | None = None, film: bool = True
) -> Path:
    """Write the report of one or more runs, and return its path.

    Args:
        runs: one run or several, or their directories; finished or not.
        out: the file; the default is report.html, in the run's directory or, for several runs, in the current one.
        film: show a film of each policy, or of the best of many, where the environment can be drawn. It is kept in the run's
            directory.

    Raises:
        LareError: something is no run, a directory has no run, or the file cannot be written.
    """
    sources = list(runs) if isinstance(runs, Iterable) and not isinstance(runs, str) else [runs]
    if not sources:
        raise LareError("No runs to report. Name one run or more.")
    opened: list[Run] = []
    for source in sources:
        is_path = isinstance(source, (str, Path))
        opened += map(_open_run, find_run_directories([Path(source)])) if is_path else [as_run(source)]
    reported_runs = _name_runs(opened)
    path = default_path([run.directory for run in opened]) if out is None else Path(out)
    check_new_path(path, overwrite=True)
    return write_page(path, _title(reported_runs), "\n".join(_render_body(reported_runs, film)))


def default_path(directories: Sequence[Path]) -> Path:
    """Return the path of the report of some runs. A report of several does not replace that of one of them."""
    return (directories[0] if len(directories) == 1 else Path()) / "report.html"


def _open_run(directory: Path) -> Run:
    """Open a run, without functions if it has no checkpoint, or its module is untrusted: a report does not import it."""
    run = open_without_functions(directory)
    return open_run(directory) if _can_load(run) else run


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
    are_few = len(reported_runs) <= MAX_TITLE_RUNS
    names = ", ".join(reported.name for reported in reported_runs) if are_few else f"{len(reported_runs)} runs"
    return f"{', '.join(_task_names(reported_runs))}: {names}"


def _task_names(reported_runs: Sequence[ReportedRun]) -> list[str]:
    return sorted({reported.run.config.task.name for reported in reported_runs})


def _render_body(reported_runs: Sequence[ReportedRun], film: bool) -> Iterable[str]:
    """Yield all sections, by task: what was reached, learning curves, and the details of each run."""
    for task in _task_names(reported_runs):
        task_runs = [reported for reported in reported_runs if reported.run.config.task.name == task]
        yield from _render_task(sort_runs(task_runs), film)
    yield from render_settings(reported_runs)
    yield render_words()
    yield render_note(f"Drawn by LaRe {code_version()}.")


def _render_task(runs: Sequence[ReportedRun], film: bool) -> Iterable[str]:
    """Yield the sections on runs of a task."""
    check_same_tasks((reported.run.directory, reported.run.config.task) for reported in runs)
    task = runs[0].run.config.task
    n_random = max(n_random_episodes(reported.last_step, reported.run.config.longest_episode) for reported in runs)
    seeds: list[int] = []
    if task.group is not None:  # those of the evaluations, because groups may differ in their returns
        run = runs[0].run
        seeds = evaluation_seeds(run, run.config.settings.evaluation_episodes, in_training=True)
        n_random = round_up(n_random, len(seeds))
    random_returns = measure_random_returns(task, n_random, seeds)
    summaries = summarise_runs(runs, random_returns)
    filmed = [i for i, reported in enumerate(runs) if _can_load(reported.run)][:MAX_FILMS] if film else []
    films = {i: _load_film(runs[i].run, FILM_BYTES // len(filmed)) for i in filmed}
    figures = {i: render_film(data, f"An episode of {runs[i].name}") for i, data in films.items() if data}
    if len(runs) == 1:
        yield from render_verdict(runs[0], summaries[0], figures.get(0, ""))
        yield render_note(describe_method(runs[0].run))
        yield "<h2>Learning</h2>"
        yield from render_learning_curves(task, runs, random_returns)
        yield from _render_details(runs[0].run, summaries[0])
        yield _note_missing(runs)
        yield render_fold("Final values of each seed", [render_final_values(runs)])
        return
    yield f"<h1>{escape(task.name)}: {len(runs)} runs</h1>"
    yield render_note("To rank methods, with intervals and p-values: lare-rl compare.")
    if figures:
        yield '<div class="films">'
        for i, figure in figures.items():
            yield f"<figure>{figure}<figcaption>{escape(runs[i].name)}</figcaption></figure>"
        yield "</div>"
    yield from render_learning_curves(task, runs, random_returns)
    yield render_final_values(runs)
    yield "<h2>Each run</h2>"
    for reported, summary in zip(runs, summaries, strict=True):
        details = _render_details(reported.run, summary)
        title = f"{reported.name}: {render_headline(summary)}" if summary else reported.name
        verdict = render_verdict(reported, summary, has_title=False)
        yield render_fold(title, [*verdict, render_note(describe_method(reported.run)), *details])
    yield _note_missing(runs)


def _render_details(run: Run, summary: RunSummary | None) -> list[str]:
    """Return what a run's checkpoint and files show. If they cannot be used, say why: the rest of the report does not need them."""
    trust = list(render_trust(summary))
    try:
        return list(render_details(run, trust))
    except LareError as error:
        return [*trust, render_note(f"There are no credit and factors to show: {error}.")]


def _note_missing(runs: Sequence[ReportedRun]) -> str:
    """Return a note about runs without a checkpoint."""
    names = [reported.name for reported in runs if not reported.run.has_checkpoint()]
    if not names:
        return ""
    return render_note(f"Without a checkpoint, there are no film, credit and factors to show: {', '.join(names)}.")


def _can_load(run: Run) -> bool:
    """Return whether a report may load the checkpoint."""
    return run.has_checkpoint() and untrusted_module(run.config.task) is None


def _load_film(run: Run, max_bytes: int) -> bytes | None:
    """Return the film in the run's directory, or make one if it is older than the checkpoint. None if nothing can be drawn here."""
    path, written = run.directory / FILM, (run.checkpoint / STATE_FILE).stat().st_mtime
    if path.is_file() and path.stat().st_size <= max_bytes and path.stat().st_mtime >= written:
        return path.read_bytes()
    try:
        film = encode_film(*record_frames(run, max_frames=MAX_FRAMES), max_bytes)
    except LareError:
        return None
    with suppress(LareError):
        write_bytes(path, film)
    return film
