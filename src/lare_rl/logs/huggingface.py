"""A Hugging Face data set on the disk, as `Dataset.save_to_disk` writes it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError, needs_extra, shortened

try:
    import datasets
    import pyarrow as pa
except ImportError as missing:
    raise needs_extra("a Hugging Face data set", "datasets") from missing

from lare_rl.logs import tables
from lare_rl.logs.tables import Format

STATE, SPLITS = "state.json", "dataset_dict.json"
"""Files of a data set, and of a directory of several."""


def batches(path: Path) -> Iterator[pa.RecordBatch]:
    """Read some rows at a time."""
    if (path / SPLITS).exists():
        names = ", ".join(sorted(str(state.parent) for state in path.glob(f"*/{STATE}")))
        raise LareError(f"{path} holds several data sets: name one of {names}")
    try:
        rows: Any = datasets.Dataset.load_from_disk(str(path)).with_format("arrow")
        for table in rows.iter(tables.ROWS):
            yield from table.to_batches()
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise LareError(f"{path} is no Hugging Face data set, or a damaged one: {shortened(error)}") from error


def write(path: Path, parts: Iterator[pa.Table]) -> None:
    """Write a data set of one split."""
    rows = path / "rows" / "rows.arrow"
    rows.parent.mkdir(parents=True)
    first = next(parts)
    with pa.OSFile(str(rows), "wb") as file, pa.ipc.new_stream(file, first.schema) as writer:
        writer.write_table(first)
        for part in parts:
            writer.write_table(part)
    with silent():
        datasets.Dataset.from_file(str(rows)).save_to_disk(str(path))
    shutil.rmtree(rows.parent)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Without the library's own progress bars."""
    shown = not datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        if shown:
            datasets.enable_progress_bars()


HUGGING_FACE = Format(batches, write)
