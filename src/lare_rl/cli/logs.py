"""The command `relabel`: rewards for the steps of logged episodes."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from lare_rl.cli.terminal import print_line, print_progress


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
    """Give the steps of logged episodes rewards that are fitted to the episodes' returns, and report how well they predict returns.

    Writes the same data with the new rewards; the old rewards are kept beside them, as `paid`. No simulator is needed
    (docs/tutorials/your-own-logs.md).

    Args:
        dataset: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, or the id of a local
            Minari data set.
        out: the path to write, or the id of the new Minari data set. It is written whole or not at all.
        task: a shipped name (see `lare-rl tasks`), or the path of a task file: the task that --function was designed for. It says
            how an episode is paid (docs/how-to/scores.md), and has the time limit and the number of discrete actions. Its environment
            is not created.
        function: a latent function (.py), verified on steps of the data before it is run.
        method: how credit is assigned (see `lare-rl methods`); the default is lare-bayes with --function, bayes without.
        hold_out: share of the episodes that are kept out of the fit, to measure how well returns are predicted.
        updates: number of gradient updates of the decoder. A closed-form decoder has none.
        memory: about how many GiB the decoder's inputs may take. A closed-form fit uses all episodes, whatever this limit is.
        seed: seed of the choice of held-out episodes and of the decoder's initial weights.
        overwrite: replace --out if it exists.
    """
    import lare_rl
    from lare_rl.envs.load import read_task
    from lare_rl.errors import LareError

    spec = None if task is None else read_task(task)
    phi = None
    if function is not None:
        if spec is None:
            raise LareError("--function needs the --task that it was designed for")
        phi = lare_rl.load_function(function, spec, steps=lare_rl.logged_steps(dataset, spec))
    # An exception, unlike the default of this signal, removes a half-written output.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    with _progress_bars() as listener:
        result = lare_rl.relabel(
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
            listener=listener,
        )
    for line in result.summary:
        print_line(line)
    print_line(f"wrote {result.out}")


@contextmanager
def _progress_bars() -> Iterator[Callable[[str, int, int | None], None]]:
    """Show a progress bar on stderr for each pass over the data, or only a line if stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bars:
        bar_ids = {}

        def update(stage: str, n_done: int, n_episodes: int | None) -> None:
            if stage not in bar_ids:
                name = {"fit": "learning", "write": "writing"}[stage]
                bar_ids[stage] = bars.add_task(name, total=n_episodes)
                if bars.disable:
                    number = "an unknown number of" if n_episodes is None else f"{n_episodes:,}"
                    print_progress(f"{name}, {number} episodes")
            bars.update(bar_ids[stage], completed=n_done)

        yield update
