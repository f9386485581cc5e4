"""The progress of a sweep: a bar for each active run and one for all runs; without a terminal, only lines."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from lare_rl.cli.terminal import progress
from lare_rl.errors import LareError
from lare_rl.sweep.jobs import Job
from lare_rl.util.sanitize import legible

EVERY = 2.0
"""Seconds between two updates of the bars."""


@contextlib.contextmanager
def watching(jobs: Sequence[Job]) -> Iterator[Callable[[str], None]]:
    """Show the progress of a sweep; yields the function that prints its messages."""
    if not sys.stderr.isatty():
        yield progress
        return
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeRemainingColumn(),
    )
    ended = threading.Event()
    with Progress(*columns, console=console, transient=True) as bars:
        looking = threading.Thread(target=look, args=(jobs, bars, ended), daemon=True)
        looking.start()
        try:
            yield lambda text: console.print(legible(text), highlight=False, markup=False)
        finally:
            ended.set()
            looking.join()


def look(jobs: Sequence[Job], bars: Progress, ended: threading.Event) -> None:
    """Update the bars until the sweep has ended."""
    whole = bars.add_task("all runs", total=sum(job.resolved.steps for job in jobs))
    own: dict[str, TaskID] = {}
    while not ended.is_set():
        steps = {job.name: step_of(job) for job in jobs}
        bars.update(whole, completed=sum(steps.values()))
        for job in jobs:
            done = steps[job.name]
            if 0 < done < job.resolved.steps and job.name not in own:
                own[job.name] = bars.add_task(job.name, total=job.resolved.steps)
            if job.name in own:
                bars.update(own[job.name], completed=done, visible=done < job.resolved.steps)
        ended.wait(EVERY)


def step_of(job: Job) -> int:
    """The number of steps that a run has done. A damaged run counts as 0; the process that trains it reports the damage."""
    try:
        return job.step() if job.begun else 0
    except LareError:
        return 0
