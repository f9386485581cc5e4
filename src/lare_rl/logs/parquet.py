"""A Parquet file, or a directory of them in the order of their names. The output is one file."""

from collections.abc import Iterator
from pathlib import Path

from lare_rl.errors import LareError, needs_extra, shortened

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as missing:
    raise needs_extra("a Parquet file", "parquet") from missing

from lare_rl.logs import tables
from lare_rl.logs.tables import Format


def batches(path: Path) -> Iterator[pa.RecordBatch]:
    """Read some rows at a time, of all files."""
    files, schema = sorted(path.glob("*.parquet")) if path.is_dir() else [path], None
    for file in files:
        try:
            with pq.ParquetFile(file) as opened:
                schema = schema or opened.schema_arrow
                if opened.schema_arrow != schema:
                    raise LareError(f"{file} has other columns than {files[0]}")
                yield from opened.iter_batches(tables.ROWS)
        except (OSError, pa.ArrowException, NotImplementedError) as error:
            raise LareError(f"{file} is no Parquet file, or a damaged one: {shortened(error)}") from error


def write(path: Path, parts: Iterator[pa.Table]) -> None:
    """Write one file."""
    first = next(parts)
    with pq.ParquetWriter(path, first.schema) as writer:
        writer.write_table(first)
        for part in parts:
            writer.write_table(part)


PARQUET = Format(batches, write)
