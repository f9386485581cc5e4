"""A Parquet file, or a directory of them in the order of their names. The output is one file."""

from collections.abc import Iterator
from pathlib import Path

from lare_rl.errors import LareError, missing_extra_error, short_repr

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as missing:
    raise missing_extra_error("a Parquet file", "parquet") from missing

from lare_rl.logs.tables import BATCH_ROWS, TableLog, write_tables

__all__ = ["ParquetLog"]


class ParquetLog(TableLog):
    """Parquet files with the same columns."""

    def read_batches(self) -> Iterator[pa.RecordBatch]:
        files = sorted(self.path.glob("*.parquet")) if self.path.is_dir() else [self.path]
        schema = None
        for file in files:
            try:
                with pq.ParquetFile(file) as reader:
                    schema = schema or reader.schema_arrow
                    if reader.schema_arrow != schema:
                        raise LareError(f"{file} has other columns than {files[0]}")
                    yield from reader.iter_batches(BATCH_ROWS)
            except (OSError, pa.ArrowException, NotImplementedError) as error:
                raise LareError(f"{file} is not a Parquet file, or damaged: {short_repr(error)}") from error

    def write_file(self, path: Path, tables: Iterator[pa.Table]) -> None:
        write_tables(tables, lambda schema: pq.ParquetWriter(path, schema))
