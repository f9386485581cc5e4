"""`lare-rl reproduce`: an exhibit of the paper, from its runs to its page."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryFile

from lare_rl.compare.metric_tables import read_metric_rows, write_table
from lare_rl.errors import LareError
from lare_rl.sweep.jobs import Job, check_job
from lare_rl.sweep.resources import Resources
from lare_rl.sweep.sweep import run_sweep
from paper import correlations, real, regret, trained
from paper.exhibits import Budget, budgets, exhibit_jobs, exhibits
from paper.pages import Page, write_page

UNTRAINED: dict[str, tuple[str, str, Callable[[Budget, str], Page]]] = {
    "table-1": ("table 1", correlations.TITLE, correlations.make_page),
    "theory": ("propositions 1 and 2", regret.TITLE, regret.make_page),
}
"""Exhibits that need no training: place in the paper, title, and the page."""

REAL = "real"
"""The name of the study of five tasks of real simulators, which is no exhibit of the paper. `real-TASK` is one task of it."""

Watching = Callable[[Sequence[Job]], AbstractContextManager[Callable[[str], None]]]
"""Shows the progress of jobs; yields the function that prints messages."""


def listed() -> Iterator[tuple[str, str, str]]:
    """Name, place in the paper, and title of every exhibit."""
    yield from ((name, exhibit.source, exhibit.title) for name, exhibit in exhibits().items())
    yield from ((name, source, title) for name, (source, title, _) in UNTRAINED.items())
    yield REAL, real.SOURCE, real.TITLE
    yield from ((f"{REAL}-{task}", real.SOURCE, f"{real.TITLE}: {task}") for task in real.read_study().tasks)


def quiet(jobs: Sequence[Job]) -> AbstractContextManager[Callable[[str], None]]:
    """A `Watching` that shows nothing."""
    return nullcontext(lambda text: None)


def reproduce(
    name: str,
    budget: str,
    share: Resources,
    root: Path,
    out: Path,
    ray: str | None = None,
    watching: Watching = quiet,
) -> Path:
    """Train the missing runs of an exhibit, and write its page. Finished runs are used without training.

    Args:
        name: name of the exhibit.
        budget: `smoke`, `laptop` or `paper`.
        root: the directory for all runs of all budgets.
        out: the directory for pages, OUT/BUDGET/NAME.md. All metrics of the runs are there too, as NAME.csv.

    Raises:
        LareError: there is no such exhibit, or one of the runs failed.
    """
    shared_budget, command = budgets()[budget], f"lare-rl reproduce {name} --budget {budget}"
    names = [exhibit_name for exhibit_name, _, _ in listed()]
    if name not in names:
        raise LareError(f"no exhibit {name!r}; the exhibits are {', '.join(names)}")
    # Checked before the first run is trained, because otherwise an error would come only after hours.
    folder = room_for(out / budget, name)
    if name in UNTRAINED:
        make_page = UNTRAINED[name][-1]
        return write_page(make_page(shared_budget, command), folder)
    directory = root / budget
    study, _, task = name.partition("-")
    is_real = study == REAL
    if is_real:
        jobs = real.plan_jobs(budget, directory / REAL, [task] if task else list(real.read_study().tasks))
    else:
        jobs = exhibit_jobs(exhibits()[name], budget, directory)
    all_jobs = [job for task_jobs in jobs.values() for contender_jobs in task_jobs.values() for job in contender_jobs]
    for job in all_jobs:
        check_job(job)
    with watching(all_jobs) as listener:
        failed = run_sweep(share, all_jobs, listener, ray)
    if failed:
        failed_names = ", ".join(job.name for job in failed)
        raise LareError(f"{len(failed)} of {len(all_jobs)} runs failed, so there is no page: {failed_names}")
    write_table(read_metric_rows(job.directory for job in all_jobs), folder / name)
    if is_real:
        return write_page(real.make_page(name, budget, jobs, command), folder)
    page = trained.make_page(name, exhibits()[name], shared_budget, jobs, command)
    return write_page(page, folder)


def room_for(directory: Path, name: str) -> Path:
    """Create the directory if it is missing. Raises `LareError` if the page and its table cannot be written into it."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path in (directory / f"{name}.md", directory / f"{name}.csv"):
            if path.exists():
                path.open("a").close()
        with TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise LareError(f"nothing can be written into {directory}: {error.strerror}") from error
    return directory
