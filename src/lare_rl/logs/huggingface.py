"""A Hugging Face data set on the disk, as `Dataset.save_to_disk` writes it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError, missing_extra_error, short_repr

try:
    import datasets
    import pyarrow as pa
except ImportError as missing:
    raise missing_extra_error("a Hugging Face data set", "datasets") from missing

from lare_rl.logs.tables import TableLog, batch_rows, write_tables

__all__ = ["HuggingFaceLog"]


class HuggingFaceLog(TableLog):
    """A data set of one split."""

    def read_batches(self) -> Iterator[pa.RecordBatch]:
        if (self.path / "dataset_dict.json").exists():
            names = ", ".join(sorted(str(state.parent) for state in self.path.glob("*/state.json")))
            raise LareError(f"{self.path} has several splits: name one of {names}")
        try:
            dataset: Any = datasets.Dataset.load_from_disk(str(self.path)).with_format("arrow")
            for table in dataset.iter(batch_rows(dataset.features.arrow_schema)):
                yield from table.to_batches()
        except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
            raise LareError(f"{self.path} is not a Hugging Face data set, or damaged: {short_repr(error)}") from error

    def write_file(self, path: Path, tables: Iterator[pa.Table]) -> None:
        rows = path / "rows" / "rows.arrow"
        rows.parent.mkdir(parents=True)
        with pa.OSFile(str(rows), "wb") as file:
            write_tables(tables, lambda schema: pa.ipc.new_stream(file, schema))
        with _no_progress_bars():
            datasets.Dataset.from_file(str(rows)).save_to_disk(str(path))
        shutil.rmtree(rows.parent)


@contextlib.contextmanager
def _no_progress_bars() -> Iterator[None]:
    were_enabled = not datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        yield
    finally:
        if were_enabled:
            datasets.enable_progress_bars()
