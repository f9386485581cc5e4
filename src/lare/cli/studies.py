"""Studies of many runs."""

import importlib
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from lare.cli.terminal import RunDirectories, progress, say, show
from lare.errors import LareError

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
"""In a checkout; there is no such directory where LaRe was installed from an index."""

Ray = Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")]


def sweep(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    ray: Ray = None,
) -> None:
    """Train many runs: what a TOML file asks for and is not done yet. All metrics go to results.csv and .parquet.

    Args:
        file: tasks, methods, algorithms, draws, settings; processes at a time, and cores of each (docs/sweeps.md).
        ray: a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
    """
    from lare.cli.watch import watching
    from lare.experiments.sweep import read_sweep, run_sweep
    from lare.experiments.tables import rows_of, write_table

    wanted, jobs = read_sweep(file)

    def tabulate() -> None:
        rows = rows_of(job.directory for job in jobs)
        for path in write_table(rows, jobs[0].directory.parent.parent / "results") if rows else ():
            say(f"wrote {path}")

    try:
        with watching(jobs) as said:
            failed = run_sweep(wanted, jobs, said, ray)
    except BaseException:
        with suppress(LareError):  # what stopped the sweep is what is to be said
            tabulate()
        raise
    tabulate()
    if failed:
        sys.exit(1)


def compare(runs: RunDirectories, out: Path = Path("compare.html")) -> None:
    """Compare methods by their runs: interquartile means with bootstrap intervals, profiles, probability of improvement.

    Args:
        runs: run directories, or directories that hold some, as that of a sweep; the first run's method is what the others are
            compared with.
        out: the page to write.
    """
    from lare.experiments.compare import HEAD, cells, find_runs, what_scores_are, write_comparison
    from lare.experiments.statistics import too_few

    comparison = write_comparison(find_runs(runs), out)
    show(HEAD, cells(comparison))
    say(f"{what_scores_are(comparison)} {too_few(comparison)}".rstrip())
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
    """Train a figure or a table of the LaRe paper anew, in a checkout, and write a page that compares it with the paper's.

    Args:
        exhibit: its name, or all; without it, they are listed.
        budget: smoke, to see that it runs; laptop, 3 seeds and a twentieth of a single agent's steps, some tasks; paper, all.
        runs: the directory of the runs; finished ones are not trained again.
        out: the directory of the pages: OUT/BUDGET/NAME.md, with its pictures and all metrics.
        processes: runs at a time.
        cores: of each run.
        ray: a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
    """
    from lare.cli.watch import watching
    from lare.experiments.sweep import Share
    from lare.training.train import Interrupted

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
        except LareError as error:  # one that fails is no reason to leave the others out
            failed += 1
            progress(f"{name}: {error}")
    if failed:
        raise LareError(f"{failed} of {len(names)} exhibits have no page")


def from_the_checkout(module: str) -> ModuleType:
    """A module of `benchmarks/paper`, which only a checkout has. Raises `LareError` where LaRe was installed without one."""
    if not (BENCHMARKS / "paper" / f"{module}.py").is_file():
        raise LareError(
            "lare reproduce needs a checkout, whose directory benchmarks/paper describes the exhibits: clone the repository, and "
            "install it there by pip install -e '.[statistics]'"
        )
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(f"paper.{module}")
