"""The commands for many runs: `sweep`, `compare` and `reproduce`."""

import importlib
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import RunDirectories, progress, say, show
from lare_rl.errors import LareError

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
"""A directory of the checkout. It does not exist if LaRe was installed from a package index."""

Ray = Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")]


def sweep(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    ray: Ray = None,
    check: bool = False,
) -> None:
    """Train the runs that a TOML file lists and that are not finished yet. All metrics go to results.csv and .parquet.

    Args:
        file: lists tasks, methods, algorithms, draws and settings, and how many processes run at a time, on how many cores each
            (docs/sweeps.md).
        ray: the address of a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
        check: only check the file, list its runs and how far they are, and train nothing.
    """
    from lare_rl.cli.sweep_progress import watching
    from lare_rl.compare.metric_tables import rows_of, write_table
    from lare_rl.sweep.processes import shares
    from lare_rl.sweep.sweep import is_done, read_sweep, run_sweep

    wanted, jobs = read_sweep(file)
    for job in jobs:
        if warning := job.resolved.untrained:
            progress(f"{job.name}: {warning}")
    if check:
        if ray is None:
            try:
                shares(wanted.processes, wanted.cores)
            except LareError as error:  # the sweep may be meant for another machine
                progress(f"{error}: the sweep would not begin on this machine")
        for job in jobs:
            say(f"{job.name}: {'done' if is_done(job) else f'step {job.step():,} of {job.resolved.steps:,}'}")
        return

    def tabulate() -> None:
        rows = rows_of(job.directory for job in jobs)
        for path in write_table(rows, jobs[0].directory.parent.parent / "results") if rows else ():
            say(f"wrote {path}")

    try:
        with watching(jobs) as said:
            failed = run_sweep(wanted, jobs, said, ray)
    except BaseException:
        with suppress(LareError):  # the error to report is the one that stopped the sweep
            tabulate()
        raise
    tabulate()
    if failed:
        sys.exit(1)


def compare(
    runs: RunDirectories,
    metric: Annotated[str, tyro.conf.arg(metavar="KEY")] = "evaluation/return",
    at: Annotated[int | None, tyro.conf.arg(metavar="STEP")] = None,
    late: bool = False,
    out: Path = Path("compare.html"),
) -> None:
    """Compare methods by their runs: interquartile means with bootstrap intervals, profiles, probability of improvement.

    Args:
        runs: run directories, directories that contain some, such as that of a sweep, or .csv files with results of other programs
            (docs/sweeps.md). The first method is the baseline that the others are compared with.
        metric: the key of metrics.jsonl to compare.
        at: the step at which runs are compared; by default the last one at which all were evaluated.
        late: compare means over the evaluations after three quarters of the steps, which vary less than the last one.
        out: the page to write.
    """
    from lare_rl.compare import compare as page

    found, remarks = page.find_all(runs, metric)
    for remark in remarks:
        progress(remark)
    comparisons = page.write_comparisons(found, out, metric, remarks, at, late)
    for comparison in comparisons:
        if len(comparisons) > 1:
            say(f"\n{comparison.tasks[0]}")
        show(*page.cells(comparison))
        say(page.said_of(comparison))
    if rows := page.cells_of_all(comparisons):
        say("\nAll tasks: each run is compared with the runs on the same task.")
        show(page.HEAD_OF_ALL, rows)
    elif len(comparisons) > 1:
        say(
            "\nNo table over all tasks: it needs the same baseline, and another method, on every task with equally many seeds."
        )
    say(page.MEANINGS)
    say(f"wrote {out}")


def reproduce(
    exhibit: Annotated[Positional[str | None], tyro.conf.arg(metavar="NAME")] = None,
    budget: Literal["smoke", "laptop", "paper"] = "laptop",
    runs: Path = Path("runs/reproduce"),
    out: Path = Path("results"),
    processes: int = 1,
    cores: int = 1,
    ray: Ray = None,
) -> None:
    """Reproduce a figure or table of the LaRe paper: train its runs, and write a page that compares the results. Needs a checkout.

    Args:
        exhibit: the name of a figure or a table, or all; without it, the names are listed.
        budget: smoke only tests that it runs; laptop has 3 seeds, a twentieth of a single agent's steps, and some of the tasks;
            paper has everything.
        runs: the directory of the runs; finished ones are not trained again.
        out: the directory of the pages: OUT/BUDGET/NAME.md, with its pictures and all metrics.
        processes: number of runs at a time.
        cores: number of cores for each run.
        ray: the address of a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
    """
    from lare_rl.cli.sweep_progress import watching
    from lare_rl.sweep.sweep import Share
    from lare_rl.training.train import Interrupted

    paper = from_the_checkout("reproduce")
    if exhibit is None:
        show(("exhibit", "of the paper", "what it shows"), paper.listed())
        return
    share = Share(processes=processes, cores=cores)

    def make(name: str) -> None:
        say(f"wrote {paper.reproduce(name, budget, share, runs, out, ray, watching)}")

    if exhibit != "all":
        make(exhibit)
        return
    names = [name for name, _, _ in paper.listed()]
    failed = 0
    for name in names:
        try:
            make(name)
        except Interrupted:
            raise
        except LareError as error:  # the other exhibits are still made
            failed += 1
            progress(f"{name}: {error}")
    if failed:
        raise LareError(f"{failed} of {len(names)} exhibits have no page")


def from_the_checkout(module: str) -> ModuleType:
    """A module of `benchmarks/paper`, which only a checkout has. Raises `LareError` if LaRe was installed without one."""
    if not (BENCHMARKS / "paper" / f"{module}.py").is_file():
        raise LareError(
            "lare-rl reproduce needs a checkout, whose directory benchmarks/paper describes the exhibits: clone the repository, and "
            "install it there by pip install -e '.[statistics]'"
        )
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(f"paper.{module}")
