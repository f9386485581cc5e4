"""The commands for many runs: `sweep`, `compare` and `reproduce`."""

import importlib
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import RunDirectories, print_line, print_progress, print_table
from lare_rl.errors import LareError
from lare_rl.runs.metric_names import RETURN
from lare_rl.sweep.resources import Resources, assign_slots
from lare_rl.util.files import check_new_path

_BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
"""A directory of the checkout. It does not exist if LaRe was installed from a package index."""

_ONE_RUN = Resources()
_RAY_HELP = "the address of a Ray cluster to train on instead of this machine, or local (needs the extra lare-rl[ray])."
Ray = Annotated[str | None, tyro.conf.arg(metavar="ADDRESS", help=_RAY_HELP)]


def sweep(
    file: Annotated[Positional[Path], tyro.conf.arg(metavar="FILE")], ray: Ray = None, check: bool = False
) -> None:
    """Train the runs of a TOML file that are not finished yet. All metrics go to results.csv beside the runs, and with the
    extra lare-rl[parquet] to results.parquet.

    Args:
        file: lists tasks, methods, algorithms, draws and settings, and how many processes run at a time, on how many cores and
            accelerators each (docs/how-to/sweeps.md).
        check: only check the file, list its runs and how far they are, and train nothing.
    """
    from lare_rl.cli.sweep_progress import current_step, show_progress
    from lare_rl.compare.metric_tables import read_metric_rows, write_table
    from lare_rl.config.effective import warmup_warning
    from lare_rl.sweep.sweep import read_sweep, run_sweep

    resources, jobs = read_sweep(file)
    for job in jobs:
        if warning := warmup_warning(job.resolved):
            print_progress(f"{job.name}: {warning}")
    if check:
        if ray is None:
            try:
                assign_slots(resources)
            except LareError as error:  # the sweep may be meant for another machine
                print_progress(f"{error}: the sweep would not begin on this machine")
        for job in jobs:
            print_line(f"{job.name}: {'done' if job.done else f'step {current_step(job):,} of {job.resolved.steps:,}'}")
        return

    def write_tables() -> None:
        if rows := read_metric_rows([job.directory for job in jobs], print_progress):
            for path in write_table(rows, jobs[0].directory.parent.parent / "results"):
                print_line(f"wrote {path}")

    try:
        with show_progress(jobs) as on_message:
            failed_jobs = run_sweep(resources, jobs, on_message, ray)
    except BaseException:
        with suppress(LareError):  # the error to report is the one that stopped the sweep
            write_tables()
        raise
    write_tables()
    if failed_jobs:
        sys.exit(1)


def compare(
    runs: RunDirectories,
    metric: Annotated[str, tyro.conf.arg(metavar="KEY")] = RETURN,
    at: Annotated[int | None, tyro.conf.arg(metavar="STEP")] = None,
    late: bool = False,
    out: Path = Path("compare.html"),
) -> None:
    """Compare methods by their runs: interquartile means with bootstrap intervals, profiles, probability of improvement.

    Args:
        runs: run directories, directories that contain some, such as that of a sweep, or .csv files with results of other programs
            (docs/how-to/sweeps.md). The baseline is the first method, or episodic for a single directory.
        metric: the key of metrics.jsonl to compare.
        at: the step at which runs are compared; by default the last one at which all were evaluated.
        late: compare means over the evaluations after three quarters of the steps, which vary less than the last one.
        out: the page to write.
    """
    from lare_rl.compare import page
    from lare_rl.compare.collect import collect_results
    from lare_rl.compare.messages import MESSAGES
    from lare_rl.compare.scores import ScoreChoice
    from lare_rl.util.findings import render

    check_new_path(out, "--out", overwrite=True)
    if out.exists() and out.suffix != ".html":
        raise LareError(f"{out} exists, and is no page (.html): choose another --out")
    results, findings = collect_results(runs, metric)
    for finding in findings:
        print_progress(render(finding, MESSAGES))
    comparisons, overall = page.write_comparisons(results, out, ScoreChoice(metric, at, late), findings)
    for comparison in comparisons:
        if len(comparisons) > 1:
            print_line(f"\n{comparison.task}")
        print_table(*page.comparison_table(comparison))
        print_line(page.describe(comparison))
    if overall:
        print_line(f"\n{MESSAGES['over_tasks']}")
        print_table(page.OVERALL_HEADER, overall)
    elif len(comparisons) > 1:
        print_line(f"\n{MESSAGES['no_overall_table']}")
    print_line(MESSAGES["columns"])
    print_line(f"wrote {out}")


def reproduce(
    exhibit: Annotated[Positional[str | None], tyro.conf.arg(metavar="NAME")] = None,
    budget: Literal["smoke", "laptop", "paper"] = "laptop",
    runs: Path = Path("runs/reproduce"),
    out: Path = Path("results"),
    resources: Annotated[Resources, tyro.conf.arg(name="")] = _ONE_RUN,
    ray: Ray = None,
) -> None:
    """Reproduce a figure or table of the LaRe paper: train its runs, and write a page that compares the results. Needs a checkout.

    `real` is not in the paper: five tasks of real simulators, a package of its own (benchmarks/real). `real-wheat` is one of them.

    Args:
        exhibit: the name of an exhibit, or all for every exhibit of the paper; without it, the names are listed.
        budget: smoke only tests that it runs; laptop has 3 seeds, a twentieth of a single agent's steps, and some of the tasks;
            paper has everything.
        runs: the directory of the runs; finished ones are not trained again.
        out: the directory of the pages: OUT/BUDGET/NAME.md, with its pictures and all metrics.
        resources: what the runs use.
    """
    from lare_rl.cli.sweep_progress import show_progress
    from lare_rl.training.train import RunInterruptedError

    paper = _import_exhibits()
    if exhibit is None:
        print_table(("exhibit", "of the paper", "what it shows"), paper.listed())
        return

    def write_page(name: str) -> None:
        print_line(f"wrote {paper.reproduce(name, budget, resources, runs, out, ray, show_progress)}")

    if exhibit != "all":
        write_page(exhibit)
        return
    names = [name for name, _, _ in paper.listed() if not name.startswith(paper.REAL)]
    n_failed = 0
    for name in names:
        try:
            write_page(name)
        except RunInterruptedError:
            raise
        except LareError as error:  # the other exhibits are still made
            n_failed += 1
            print_progress(f"{name}: {error}")
    if n_failed:
        print_progress(f"{n_failed} of {len(names)} exhibits have no page")
        sys.exit(1)


def _import_exhibits() -> ModuleType:
    """Import `benchmarks/paper/reproduce.py`, which only a checkout has."""
    if not (_BENCHMARKS / "paper" / "reproduce.py").is_file():
        raise LareError(
            "lare-rl reproduce needs a checkout, which describes the exhibits: clone the repository, and install it there by "
            "pip install -e '.[all]'"
        )
    if str(_BENCHMARKS) not in sys.path:
        sys.path.append(str(_BENCHMARKS))
    return importlib.import_module("paper.reproduce")
