"""Logs of the past: rewards for steps that somebody recorded."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare.cli.terminal import progress, say


def relabel(
    dataset: Annotated[Positional[str], tyro.conf.arg(metavar="DATASET")],
    out: Annotated[str, tyro.conf.arg(metavar="NEW")],
    task: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None,
    function: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    method: str | None = None,
    hold_out: float = 0.1,
    updates: int = 10_000,
    memory: float = 1.0,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Give the steps of logged episodes rewards that add up to what the episodes returned, and say how good they are.

    Writes the same data with the new rewards; what was paid is kept beside them, as `paid`. No simulator is needed (docs/logs.md).

    Args:
        dataset: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, or the id of a local
            data set of Minari's.
        out: the path or, for a data set of Minari's, the id to write. It is written whole or not at all.
        task: a shipped name (see `lare tasks`), or the path of a task file: what --function was designed for, the time limit, and
            of how many choices actions are. Its environment is not made.
        function: a latent function (.py), verified on steps of the data before it is run.
        method: how credit is assigned (see `lare methods`); lare-bayes with --function, bayes without.
        hold_out: share of the episodes that nothing is fitted to, so that they can tell how well returns are predicted.
        updates: of a decoder that descends a gradient. In closed form there are none.
        memory: GiB, about, for what the decoder sees of steps. A fit in closed form goes by all episodes, whatever fits into it.
        seed: of what is held out, and of a decoder's weights.
        overwrite: replace what is at --out.
    """
    import lare
    from lare.errors import LareError
    from lare.tasks.spec import read_task

    spec = None if task is None else read_task(task)
    phi = None
    if function is not None:
        if spec is None:
            raise LareError("--function needs the --task that it was designed for")
        phi = lare.load_function(function, spec, steps=lare.logged_steps(dataset, spec))
    # So that what is half written is removed where the process is asked to end.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    with shown() as told:
        found = lare.relabel(
            dataset,
            out,
            method=method,
            phi=phi,
            task=spec,
            hold_out=hold_out,
            updates=updates,
            memory=memory,
            seed=seed,
            overwrite=overwrite,
            told=told,
        )
    for line in found.words:
        say(line)
    say(f"wrote {found.out}")


@contextmanager
def shown() -> Iterator:
    """A progress bar on stderr for each pass; a line, where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bars:
        passes = {}

        def told(stage: str, done: int, count: int | None) -> None:
            if stage not in passes:
                name = {"fit": "learning", "write": "writing"}[stage]
                passes[stage] = bars.add_task(name, total=count)
                if bars.disable:
                    progress(f"{name}, {'an unknown number of' if count is None else f'{count:,}'} episodes")
            bars.update(passes[stage], completed=done)

        yield told
