"""`lare reproduce`: an exhibit of the paper, from its runs to its page."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryFile

from lare.errors import LareError
from lare.experiments.jobs import Job, check
from lare.experiments.paper import correlations, regret, trained
from lare.experiments.paper.budgets import Budget
from lare.experiments.paper.exhibits import EXHIBITS, TABLE
from lare.experiments.paper.pages import Page, write_page
from lare.experiments.statistics import rliable
from lare.experiments.sweep import Share, run_sweep
from lare.experiments.tables import rows_of, write_table

UNTRAINED: dict[str, Callable[[Budget, str], Page]] = {
    "table-1": correlations.page_of,
    "theory": regret.page_of,
}
"""Exhibits that need no training."""

NAMES = (*EXHIBITS, *UNTRAINED)

Watching = Callable[[Sequence[Job]], AbstractContextManager[Callable[[str], None]]]
"""Of the runs that are to be trained: gives what is told how it goes."""


def listed() -> Iterator[tuple[str, str, str]]:
    """Name, place in the paper, and title of every exhibit."""
    yield from ((exhibit.name, exhibit.source, exhibit.title) for exhibit in TABLE)
    yield "table-1", "table 1", correlations.TITLE
    yield "theory", "propositions 1 and 2", regret.TITLE


def quiet(jobs: Sequence[Job]) -> AbstractContextManager[Callable[[str], None]]:
    """Nobody is told."""
    return nullcontext(lambda text: None)


def reproduce(
    name: str,
    budget: Budget,
    share: Share,
    root: Path,
    out: Path,
    ray: str | None = None,
    watching: Watching = quiet,
) -> Path:
    """Train what is missing for an exhibit, and write its page; what was done before, for this one or another, is left alone.

    Args:
        root: the directory for all runs of a budget.
        out: the directory for pages, OUT/BUDGET/NAME.md; all metrics of its runs are there too, as NAME.csv.

    Raises:
        LareError: there is no such exhibit, rliable is not there, or one of the runs failed.
    """
    command = f"lare reproduce {name} --budget {budget.name}"
    if name not in NAMES:
        raise LareError(f"no exhibit {name!r}; the exhibits are {', '.join(NAMES)}")
    # What would fail after an evening fails now.
    place = room_for(out / budget.name, name)
    if name in UNTRAINED:
        return write_page(UNTRAINED[name](budget, command), place)
    rliable()
    exhibit = EXHIBITS[name]
    jobs = trained.jobs_of(exhibit, budget, root / budget.name)
    every = [job for of_task in jobs.values() for some in of_task.values() for job in some]
    for job in every:
        check(job)
    with watching(every) as said:
        failed = run_sweep(share, every, said, ray)
    if failed:
        names = ", ".join(job.name for job in failed)
        raise LareError(f"{len(failed)} of {len(every)} runs failed, so there is no page: {names}")
    page = trained.page_of(exhibit, budget, jobs, command)
    write_table(rows_of(job.directory for job in every), place / name)
    return write_page(page, place)


def room_for(directory: Path, name: str) -> Path:
    """A directory in which a page and its table can be written. Raises `LareError` where they can not."""
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
