"""`lare-rl reproduce`: an exhibit of the paper, from its runs to its page."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryFile

from lare_rl.compare.metric_tables import rows_of, write_table
from lare_rl.compare.statistics import rliable
from lare_rl.errors import LareError
from lare_rl.sweep.jobs import Job, check
from lare_rl.sweep.sweep import Share, run_sweep
from paper import correlations, regret, trained
from paper.exhibits import Budget, budgets, exhibits, jobs_of
from paper.pages import Page, write_page

UNTRAINED: dict[str, tuple[str, str, Callable[[Budget, str], Page]]] = {
    "table-1": ("table 1", correlations.TITLE, correlations.page_of),
    "theory": ("propositions 1 and 2", regret.TITLE, regret.page_of),
}
"""Exhibits that need no training: place in the paper, title, and the page."""

Watching = Callable[[Sequence[Job]], AbstractContextManager[Callable[[str], None]]]
"""Shows the progress of jobs; yields the function that prints messages."""


def listed() -> Iterator[tuple[str, str, str]]:
    """Name, place in the paper, and title of every exhibit."""
    yield from ((name, exhibit.source, exhibit.title) for name, exhibit in exhibits().items())
    yield from ((name, source, title) for name, (source, title, _) in UNTRAINED.items())


def quiet(jobs: Sequence[Job]) -> AbstractContextManager[Callable[[str], None]]:
    """A `Watching` that shows nothing."""
    return nullcontext(lambda text: None)


def reproduce(
    name: str,
    budget: str,
    share: Share,
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
        LareError: there is no such exhibit, rliable is not installed, or one of the runs failed.
    """
    common, command = budgets()[budget], f"lare-rl reproduce {name} --budget {budget}"
    names = [one for one, _, _ in listed()]
    if name not in names:
        raise LareError(f"no exhibit {name!r}; the exhibits are {', '.join(names)}")
    # Checked before the first run is trained, because otherwise an error would come only after hours.
    place = room_for(out / budget, name)
    if name in UNTRAINED:
        page_of = UNTRAINED[name][-1]
        return write_page(page_of(common, command), place)
    rliable()
    exhibit = exhibits()[name]
    jobs = jobs_of(exhibit, budget, root / budget)
    every = [job for of_task in jobs.values() for some in of_task.values() for job in some]
    for job in every:
        check(job)
    with watching(every) as said:
        failed = run_sweep(share, every, said, ray)
    if failed:
        named = ", ".join(job.name for job in failed)
        raise LareError(f"{len(failed)} of {len(every)} runs failed, so there is no page: {named}")
    page = trained.page_of(name, exhibit, common, jobs, command)
    write_table(rows_of(job.directory for job in every), place / name)
    return write_page(page, place)


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
