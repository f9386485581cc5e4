"""Parquet: a row for each step, and a column `episode`, whose rows stand together."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lare.errors import LareError, shortened
from lare.logs.episode import KEYS, Logged, checked, form_of
from lare.logs.output import check_free, whole
from lare.logs.source import Hints, Paid

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as missing:
    raise LareError("Parquet files need the extra lare-rl[parquet]: pip install 'lare-rl[parquet]'") from missing

ROWS = 8192
"""That are read, and at least as many that are written, at a time."""


class ParquetLogs:
    """A file, or a directory of them in the order of their names. Other columns are kept as they are."""

    def __init__(self, path: Path, hints: Hints):
        self.name = str(path)
        self.count: int | None = None
        self.files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
        number, table = next(self.tables(), (None, None))
        if table is None:
            raise LareError(f"{path} has no rows")
        name = self.name_of(number)
        self.form = form_of(name, values_of(name, table), hints.sizes, hints.limit)

    def name_of(self, episode: Any) -> str:
        return f"{self.name}, episode {episode}"

    def tables(self) -> Iterator[tuple[Any, pa.Table]]:
        """The rows of each episode."""
        parts: list[pa.Table] = []
        known, seen = None, set()
        for batch in self.batches():
            episode = np.asarray(batch.column("episode").to_numpy(zero_copy_only=False))
            starts = np.flatnonzero(episode[1:] != episode[:-1]) + 1
            for start, end in zip([0, *starts], [*starts, len(episode)], strict=True):
                if parts and episode[start] != known:
                    yield known, pa.concat_tables(parts)
                    parts = []
                if not parts:
                    known = episode[start].item() if hasattr(episode[start], "item") else episode[start]
                    if known in seen:
                        raise LareError(
                            f"{self.name_of(known)} comes twice: the rows of an episode must stand together"
                        )
                    seen.add(known)
                parts.append(pa.Table.from_batches([batch.slice(start, end - start)]))
        if parts:
            yield known, pa.concat_tables(parts)

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Some rows at a time, of all files."""
        schema = None
        for file in self.files:
            try:
                with pq.ParquetFile(file) as opened:
                    schema = schema or opened.schema_arrow
                    if opened.schema_arrow != schema:
                        raise LareError(f"{file} has other columns than {self.files[0]}")
                    check_columns(file, schema)
                    yield from (batch for batch in opened.iter_batches(ROWS) if len(batch))
            except (OSError, pa.ArrowException, NotImplementedError) as error:
                raise LareError(f"{file} is no Parquet file, or a damaged one: {shortened(error)}") from error

    def episodes(self) -> Iterator[Logged]:
        """In the order of their rows."""
        for number, table in self.tables():
            name = self.name_of(number)
            yield checked(name, values_of(name, table), self.form, table)

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """A file."""
        check_free(Path(out), overwrite)

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """One file."""
        out, writer, waiting = Path(out), None, []
        with whole(out, overwrite) as new:
            try:
                for episode, r_hat in episodes:
                    waiting.append(relabelled(episode.kept, r_hat, episode.paid))
                    if sum(map(len, waiting)) >= ROWS:
                        writer = writer or pq.ParquetWriter(new, waiting[0].schema)
                        writer.write_table(pa.concat_tables(waiting))
                        waiting = []
                if waiting:
                    writer = writer or pq.ParquetWriter(new, waiting[0].schema)
                    writer.write_table(pa.concat_tables(waiting))
            finally:
                if writer is not None:
                    writer.close()
        return out


def check_columns(file: Path, schema: pa.Schema) -> None:
    """Raise `LareError` where rows cannot be told apart by episode, or say nothing of what a step led to."""
    for name, why in (("episode", "which the step is of"), ("next_observations", "what the step led to")):
        if schema.names.count(name) != 1:
            raise LareError(f"{file} must have one column {name}, {why}; its columns are {', '.join(schema.names)}")
    kind = schema.field("episode").type
    if not (pa.types.is_integer(kind) or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise LareError(f"{file}: episode must be whole numbers or strings, and is {kind}")


def values_of(name: str, table: pa.Table) -> dict[str, np.ndarray]:
    """The columns of an episode as arrays; its score is that of the last row."""
    found = {key: array_of(f"{name}: {key}", table.column(key)) for key in KEYS if key in table.column_names}
    if "score" in found and found["score"].ndim:
        found["score"] = found["score"][-1]
    return found


def array_of(where: str, column: pa.ChunkedArray) -> np.ndarray:
    """A column of numbers (T,), or of lists of equal length (T, n)."""
    values = column.combine_chunks()
    if values.null_count:
        raise LareError(f"{where} has rows without a value")
    sizes = []
    while (
        pa.types.is_list(values.type) or pa.types.is_large_list(values.type) or pa.types.is_fixed_size_list(values.type)
    ):
        inner, before = values.flatten(), len(values)
        size, left = divmod(len(inner), max(before, 1))
        lengths = np.diff(values.offsets.to_numpy()) if not pa.types.is_fixed_size_list(values.type) else size
        if left or np.any(lengths != size) or inner.null_count:
            raise LareError(f"{where} must be lists of one length, without gaps")
        sizes.append(size)
        values = inner
    if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type) or pa.types.is_boolean(values.type)):
        raise LareError(f"{where} must be numbers, and is {column.type}")
    return values.to_numpy(zero_copy_only=False).reshape(len(column), *sizes)


def relabelled(table: pa.Table, r_hat: np.ndarray, paid: np.ndarray) -> pa.Table:
    """With other rewards, and the old ones as `paid`."""
    for name, values in (("rewards", r_hat.astype(np.float32)), ("paid", paid)):
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, pa.array(values))
        else:
            table = table.append_column(name, pa.array(values))
    return table.replace_schema_metadata(None)
