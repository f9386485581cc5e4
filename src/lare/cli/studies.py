"""Studies of many runs."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare.cli.terminal import RunDirectories, progress, say, show


def sweep(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")],
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
) -> None:
    """Train many runs: what a TOML file asks for and is not done yet. All metrics go to results.csv and .parquet.

    Args:
        file: tasks, methods, algorithms, draws, settings; processes at a time, and cores of each (docs/sweeps.md).
        ray: a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray]).
    """
    from lare.experiments.sweep import read_sweep, run_sweep
    from lare.experiments.tables import rows_of, write_table

    wanted, jobs = read_sweep(file)
    root = jobs[0].directory.parent.parent
    try:
        failed = run_sweep(wanted, jobs, progress, ray)
    finally:
        rows = rows_of(job.directory for job in jobs)
        if rows:
            for path in write_table(rows, root / "results"):
                say(f"wrote {path}")
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

    comparison = write_comparison(find_runs(runs), out)
    show(HEAD, cells(comparison))
    say(what_scores_are(comparison))
    say(f"wrote {out}")
