"""The metrics of many runs as one table on the disk, in CSV and Parquet."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from lare_rl.runs.directory import CONFIG, read_config, read_metrics
from lare_rl.util.files import write_atomically

KEYS = ("task", "run", "method", "algorithm", "judges", "draw", "seed", "step")


def rows_of(directories: Iterable[Path]) -> list[dict[str, Any]]:
    """A row for each run, seed and evaluation."""
    rows = []
    for directory in directories:
        if not (directory / CONFIG).is_file():
            continue
        config = read_config(directory)
        plan = config.settings
        run = {
            "task": config.task.name,
            "run": directory.name,
            "method": plan.method,
            "algorithm": plan.algorithm,
            "judges": plan.judged_by(config.task),
            "draw": plan.draw,
        }
        rows += [run | line for line in read_metrics(directory)]
    return rows


def write_table(rows: Sequence[dict[str, Any]], path: Path) -> list[Path]:
    """Write PATH.csv and, with the extra `statistics`, PATH.parquet; returns the files written."""
    names = [*KEYS, *sorted({name for row in rows for name in row} - {*KEYS})]
    text = io.StringIO()
    writer = csv.DictWriter(text, names)
    writer.writeheader()
    writer.writerows(rows)
    written = [path.with_suffix(".csv")]
    write_atomically(written[0], lambda file: file.write(text.getvalue().encode()))
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return written
    table = pyarrow.Table.from_pylist([{name: row.get(name) for name in names} for row in rows])
    written.append(path.with_suffix(".parquet"))
    write_atomically(written[1], lambda file: parquet.write_table(table, file))
    return written
