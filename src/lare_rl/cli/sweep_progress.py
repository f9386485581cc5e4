"""The progress of a sweep: a bar for each active run and one for all runs; without a terminal, only lines."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from lare_rl.cli.terminal import print_progress
from lare_rl.errors import LareError
from lare_rl.sweep.jobs import Job
from lare_rl.util.sanitize import sanitize

__all__ = ["current_step", "show_progress", "update_bars"]


@contextlib.contextmanager
def show_progress(jobs: Sequence[Job]) -> Iterator[Callable[[str], None]]:
    """Show the progress of a sweep, and yield the function that prints its messages."""
    if not sys.stderr.isatty():
        yield print_progress
        return
    console = Console(stderr=True)
    percentage = TextColumn("{task.percentage:>3.0f}%")
    columns = TextColumn("{task.description}"), BarColumn(), percentage, TimeRemainingColumn()
    ended = threading.Event()
    with Progress(*columns, console=console, transient=True) as bars:
        thread = threading.Thread(target=update_bars, args=(jobs, bars, ended), daemon=True)
        thread.start()
        try:
            yield lambda text: console.print(sanitize(text), highlight=False, markup=False)
        finally:
            ended.set()
            thread.join()


def update_bars(jobs: Sequence[Job], bars: Progress, ended: threading.Event, refresh_s: float = 2.0) -> None:
    """Update the bars until the sweep has ended. Only active runs have a bar."""
    all_runs_id = bars.add_task("all runs", total=sum(job.resolved.steps for job in jobs))
    bar_ids: dict[str, TaskID] = {}
    while not ended.is_set():
        steps = {job.name: current_step(job) for job in jobs}
        bars.update(all_runs_id, completed=sum(steps.values()))
        for job in jobs:
            step, total = steps[job.name], job.resolved.steps
            if 0 < step < total and job.name not in bar_ids:
                bar_ids[job.name] = bars.add_task(job.name, total=total)
            if job.name in bar_ids:
                bars.update(bar_ids[job.name], completed=step, visible=step < total)
        ended.wait(refresh_s)


def current_step(job: Job) -> int:
    """Return the step of a run. A damaged run has step 0: the process that trains it reports the damage."""
    try:
        return job.step() if job.started else 0
    except LareError:
        return 0
