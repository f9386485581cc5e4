"""Tables with a row for each step or for each episode: Parquet files (`parquet.py`), Hugging Face data sets (`huggingface.py`).

Rows of steps have a column `episode`, and the rows of an episode follow each other. Rows of episodes hold lists.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from lare_rl.errors import LareError
from lare_rl.logs.episode import KEYS, Hints, Logged, Paid, checked, form_of
from lare_rl.logs.output import check_free, whole

ROWS = 8192
"""Rows that are read at a time, and the fewest that are written at a time."""


class Format(NamedTuple):
    """A format of tables on the disk."""

    batches: Callable[[Path], Iterator[pa.RecordBatch]]
    """Reads some rows at a time. Raises `LareError` if they cannot be read."""
    write: Callable[[Path, Iterator[pa.Table]], None]
    """Writes some tables, one after the other, as a file or a directory."""


class TableLogs:
    """A table on the disk. Columns that `relabel` does not use are kept unchanged."""

    def __init__(self, path: Path, hints: Hints, form: Format):
        self.path, self.name, self.on_disk = path, str(path), form
        self.count: int | None = None
        number, table = next(self.tables(), (None, None))
        if table is None:
            raise LareError(f"{path} has no rows")
        name = self.name_of(number)
        self.form = form_of(name, values_of(name, table), hints.sizes, hints.limit)

    def name_of(self, episode: Any) -> str:
        return f"{self.name}, episode {episode}"

    def tables(self) -> Iterator[tuple[Any, pa.Table]]:
        """The number of each episode, and its rows."""
        batches = (batch for batch in self.on_disk.batches(self.path) if len(batch))
        first = next(batches, None)
        if first is None:
            return
        check_columns(self.path, first.schema)
        batches = (batch for part in ([first], batches) for batch in part)
        if "episode" in first.schema.names:
            yield from self.of_steps(batches)
        else:
            rows = (batch.slice(row, 1) for batch in batches for row in range(len(batch)))
            yield from enumerate(pa.Table.from_batches([row]) for row in rows)

    def of_steps(self, batches: Iterator[pa.RecordBatch]) -> Iterator[tuple[Any, pa.Table]]:
        """`tables` for rows that are steps."""
        parts: list[pa.Table] = []
        known, seen = None, set()
        for batch in batches:
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

    def episodes(self) -> Iterator[Logged]:
        """All episodes, in the order of their rows."""
        for number, table in self.tables():
            name = self.name_of(number)
            yield checked(name, values_of(name, table), self.form, table)

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Check the file or directory to write."""
        check_free(Path(out), overwrite)

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write the same table with new rewards."""
        with whole(Path(out), overwrite) as new:
            self.on_disk.write(
                new, gathered(relabelled(one.episode.kept, one.r_hat, one.episode.paid) for one in episodes)
            )
        return Path(out)


def gathered(tables: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """The same rows in fewer tables, of `ROWS` rows or more."""
    waiting: list[pa.Table] = []
    for table in tables:
        waiting.append(table)
        if sum(map(len, waiting)) >= ROWS:
            yield pa.concat_tables(waiting)
            waiting = []
    if waiting:
        yield pa.concat_tables(waiting)


def check_columns(file: Path, schema: pa.Schema) -> None:
    """Raise `LareError` if the columns give no episode or no next observation of a step."""
    if rows_are_episodes(schema):
        return
    for name, why in (("episode", "the episode of the step"), ("next_observations", "the observation after the step")):
        if schema.names.count(name) != 1:
            raise LareError(f"{file} must have one column {name}, {why}; its columns are {', '.join(schema.names)}")
    kind = schema.field("episode").type
    if not (pa.types.is_integer(kind) or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise LareError(f"{file}: episode must be whole numbers or strings, and is {kind}")


def rows_are_episodes(schema: pa.Schema) -> bool:
    """Whether a row holds an episode: its rewards, or its actions if there is only a score, are a list."""
    key = "rewards" if "rewards" in schema.names else "actions"
    return "episode" not in schema.names and schema.names.count(key) == 1 and is_list(schema.field(key).type)


def is_list(kind: pa.DataType) -> bool:
    """Whether the values of a type are lists."""
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def values_of(name: str, table: pa.Table) -> dict[str, np.ndarray]:
    """The columns of an episode as arrays. If rows are steps, its score is that of the last step."""
    found = {key: array_of(f"{name}: {key}", table.column(key)) for key in KEYS if key in table.column_names}
    if rows_are_episodes(table.schema):
        return {key: values[0] for key, values in found.items()}
    if "score" in found and found["score"].ndim:
        found["score"] = found["score"][-1]
    return found


def array_of(where: str, column: pa.ChunkedArray) -> np.ndarray:
    """A column of numbers (T,), or of lists of equal length (T, n)."""
    values = column.combine_chunks()
    if isinstance(values, pa.ExtensionArray):  # an array of fixed shape in a Hugging Face data set
        values = values.storage
    if values.null_count:
        raise LareError(f"{where} has rows without a value")
    sizes = []
    while is_list(values.type):
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
    """The table with new rewards, and the old ones as `paid`."""
    whole_rows = rows_are_episodes(table.schema)
    for name, values in (("rewards", r_hat.astype(np.float32)), ("paid", paid)):
        column = pa.array([values] if whole_rows else values)
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, column)
        else:
            table = table.append_column(name, column)
    return table.replace_schema_metadata(None)
