"""The metrics of many runs as one table on the disk, in CSV and Parquet."""

import contextlib
import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError
from lare_rl.runs.config_file import CONFIG, read_config
from lare_rl.runs.metrics_file import read_metrics
from lare_rl.util.files import write_atomically, write_bytes

__all__ = ["is_sweep_table", "read_metric_rows", "write_table"]

KEYS = ("task", "run", "method", "algorithm", "scored_observation", "draw", "seed", "step")
"""The first columns of the table."""
MAX_HEADER = 10_000
"""Characters of a first line that are read."""


def read_metric_rows(
    directories: Iterable[Path], on_message: Callable[[str], object] | None = None
) -> list[dict[str, Any]]:
    """Read a row for each run, seed and evaluation.

    A run that cannot be read is left out, and `on_message` is called with the reason. Without it, the error is raised.
    """
    rows = []
    for directory in directories:
        if not (directory / CONFIG).is_file():
            continue
        try:
            config, lines = read_config(directory), read_metrics(directory)
        except LareError as error:
            if on_message is None:
                raise
            on_message(f"{directory} is not in the tables: {error}")
            continue
        settings = config.settings
        keys = {
            "task": config.task.name,
            "run": directory.name,
            "method": settings.method,
            "algorithm": settings.algorithm,
            "scored_observation": settings.choose_scored_observation(config.task),
            "draw": settings.draw,
        }
        rows += [keys | line for line in lines]
    return rows


def is_sweep_table(path: Path) -> bool:
    """Return whether a .csv file has the first columns of `write_table`."""
    with contextlib.suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8") as file:
        return file.readline(MAX_HEADER).startswith(",".join(KEYS))
    return False


def write_table(rows: Sequence[dict[str, Any]], path: Path) -> list[Path]:
    """Write PATH.csv and, with the extra `parquet`, PATH.parquet. Return the paths of the files."""
    names = [*KEYS, *sorted({name for row in rows for name in row} - {*KEYS})]
    text = io.StringIO()
    writer = csv.DictWriter(text, names)
    writer.writeheader()
    writer.writerows(rows)
    csv_path, parquet_path = (path.with_name(path.name + suffix) for suffix in (".csv", ".parquet"))
    write_bytes(csv_path, text.getvalue().encode())
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        parquet_path.unlink(missing_ok=True)  # it would have other rows
        return [csv_path]
    table = pyarrow.table({name: [row.get(name) for row in rows] for name in names})
    write_atomically(parquet_path, lambda file: parquet.write_table(table, file))
    return [csv_path, parquet_path]
