"""Tables with a row for each step or for each episode, in the memory format of Arrow, and Parquet files.

Rows of steps have a column `episode`, and the rows of an episode follow each other. Rows of episodes hold lists.
"""

import itertools
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.errors import LareError, missing_extra_error, short_repr
from lare_rl.logs.episode import KEYS, LoggedEpisode, RelabelledEpisode
from lare_rl.logs.log import BATCH_STEPS, Log, atomic_output, batch_by_steps, list_files
from lare_rl.tasks.spec import TaskSpec

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as missing:
    raise missing_extra_error("a Parquet file", "parquet") from missing

__all__ = ["ParquetLog", "TableLog", "batch_rows", "write_tables"]

BATCH_EPISODES = 16
"""Rows that are read at a time, if a row is an episode."""


class TableLog(Log):
    """A table on the disk. Columns with other names than those of `parse_episode` are copied unchanged."""

    def __init__(self, path: Path, role: TaskSpec | None):
        self.path, self.name = path, str(path)
        self.layout = self.infer_layout(role)

    @abstractmethod
    def read_batches(self) -> Iterator[pa.RecordBatch]:
        """Yield some rows at a time. Raises `LareError` if they cannot be read."""

    @abstractmethod
    def write_file(self, path: Path, tables: Iterator[pa.Table]) -> None:
        """Write tables one after the other, as a file or a directory."""

    def read(self) -> Iterator[tuple[str, dict[str, np.ndarray], pa.Table]]:
        batches = (batch for batch in self.read_batches() if len(batch))
        first = next(batches, None)
        if first is None:
            return
        names = first.schema.names
        ids = first.column(names.index("episode")).to_pylist() if "episode" in names else ()
        self.row_is_episode = _rows_are_episodes(first.schema, ids)
        _check_columns(self.path, first.schema, self.row_is_episode)
        batches = itertools.chain([first], batches)
        if self.row_is_episode:
            rows = (batch.slice(row, 1) for batch in batches for row in range(len(batch)))
            tables = enumerate(pa.Table.from_batches([row]) for row in rows)
        else:
            tables = self._group_steps(batches)
        for episode, table in tables:
            name = f"{self.name}, episode {episode}"
            yield name, _read_arrays(name, table, self.row_is_episode), table

    def write(self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str) -> Path:
        with atomic_output(Path(out), overwrite) as path:
            batches = batch_by_steps(episodes, lambda item: len(item.r_hat))
            tables = (
                pa.concat_tables([_replace_rewards(*item, self.row_is_episode) for item in batch]) for batch in batches
            )
            self.write_file(path, tables)
        return Path(out)

    def _group_steps(self, batches: Iterator[pa.RecordBatch]) -> Iterator[tuple[int | str, pa.Table]]:
        """Yield the number and the rows of each episode of a table whose rows are steps."""
        finished: set[int | str] = set()
        pieces = (piece for batch in batches for piece in _split_episodes(self.name, batch))
        for episode, group in itertools.groupby(pieces, key=itemgetter(0)):
            if episode in finished:
                raise LareError(
                    f"{self.name}, episode {episode} comes twice: sort the rows by episode or, if each file counts from 0, number "
                    "the episodes across files"
                )
            finished.add(episode)
            yield episode, pa.Table.from_batches([rows for _, rows in group])


class ParquetLog(TableLog):
    """A Parquet file, or a directory of files with the same columns, in the order of their names. The output is one file."""

    def read_batches(self) -> Iterator[pa.RecordBatch]:
        files = list_files(self.path, ".parquet") if self.path.is_dir() else [self.path]
        schema = last = None
        for file in files:
            is_new = True
            try:
                with pq.ParquetFile(file) as reader:
                    schema = schema or reader.schema_arrow
                    if reader.schema_arrow != schema:
                        column = _first_difference(schema, reader.schema_arrow)
                        raise LareError(f"{file} has other columns or types than {files[0]}, first {column}")
                    for batch in reader.iter_batches(batch_rows(schema)):
                        if is_new and last is not None:
                            _check_shard(file, last, batch)
                        is_new, last = False, batch.slice(len(batch) - 1) if len(batch) else last
                        yield batch
            except (OSError, pa.ArrowException, NotImplementedError) as error:
                raise LareError(f"{file} is not a Parquet file, or damaged: {short_repr(error)}") from error

    def write_file(self, path: Path, tables: Iterator[pa.Table]) -> None:
        write_tables(tables, lambda schema: pq.ParquetWriter(path, schema))


def write_tables(tables: Iterator[pa.Table], open_writer: Callable[[pa.Schema], AbstractContextManager[Any]]) -> None:
    """Write tables with the writer that `open_writer` opens for their schema."""
    first = next(tables)
    with open_writer(first.schema) as writer:
        for table in itertools.chain([first], tables):
            writer.write_table(table)


def batch_rows(schema: pa.Schema) -> int:
    """Return how many rows are read at a time."""
    return BATCH_EPISODES if _rows_are_episodes(schema) else BATCH_STEPS


def _split_episodes(name: str, batch: pa.RecordBatch) -> Iterator[tuple[int | str, pa.RecordBatch]]:
    """Split the rows of a batch where the number of the episode changes."""
    column = batch.column("episode")
    if column.null_count:
        raise LareError(f"{name}: the column episode has rows without a value")
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    episode_ids = np.asarray(column.to_numpy(zero_copy_only=False))
    starts = [0, *(np.flatnonzero(episode_ids[1:] != episode_ids[:-1]) + 1).tolist(), len(episode_ids)]
    for start, end in itertools.pairwise(starts):
        yield column[start].as_py(), batch.slice(start, end - start)


def _check_shard(file: Path, last: pa.RecordBatch, batch: pa.RecordBatch) -> None:
    """Raise `LareError` if a file continues the last episode of the file before by its number, and not by its observations.

    `last` is the last row of the file before.
    """
    names = {"episode", "observations", "next_observations"}
    if not len(batch) or not names <= set(batch.schema.names) or _rows_are_episodes(batch.schema):
        return
    row, next_row = ({name: rows.column(name)[0].as_py() for name in names} for rows in (last, batch))
    ends = (np.asarray(values, object) for values in (row["next_observations"], next_row["observations"]))
    if row["episode"] == next_row["episode"] and not _are_equal(*ends):
        raise LareError(
            f"{file}: episode {row['episode']} also ends the file before, and does not begin here at its last observation: number the "
            "episodes across files"
        )


def _are_equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether observations are equal as numbers of float32. Their columns may have different types."""
    try:
        return np.array_equal(a.astype(np.float32), b.astype(np.float32))
    except (TypeError, ValueError):  # not numbers, which is reported where they are read
        return True


def _check_columns(path: Path, schema: pa.Schema, row_is_episode: bool) -> None:
    """Check that no key has two columns, and that a table of steps has one column `episode` and one `next_observations`."""
    if key := next((key for key in KEYS if schema.names.count(key) > 1), None):
        raise LareError(f"{path} has {schema.names.count(key)} columns {key}: keep one")
    if row_is_episode:
        return
    for name, meaning in (("episode", "the episode of a step"), ("next_observations", "the observation after a step")):
        if schema.names.count(name) != 1:
            raise LareError(f"{path} needs one column {name}, {meaning}; its columns are {', '.join(schema.names)}")
    data_type = schema.field("episode").type
    ids = data_type.value_type if pa.types.is_dictionary(data_type) else data_type
    if not (pa.types.is_integer(ids) or _is_text(ids)):
        raise LareError(f"{path}: the column episode must be whole numbers or strings, and is {data_type}")


def _first_difference(expected: pa.Schema, actual: pa.Schema) -> str:
    """Return the name and type of the first column that two schemas do not share."""
    columns = itertools.zip_longest(
        *(schema.remove_metadata().to_string().splitlines() for schema in (expected, actual))
    )
    return next((new or old for old, new in columns if old != new), "a column")


def _rows_are_episodes(schema: pa.Schema, ids: Iterable[Any] = ()) -> bool:
    """Return whether each row is a whole episode: `rewards` (or `actions`, if there are no rewards) is a list column.

    Without rewards, the columns `episode` and `next_observations` say that rows are steps, whose actions may be lists, too. But if
    observations are lists of lists, they may be episodes: `ids`, the first values of `episode`, then decide. Steps share an id.
    """
    depth = {name: _list_depth(data_type) for name, data_type in zip(schema.names, schema.types, strict=True)}
    if "rewards" in depth:
        return depth["rewards"] > 0
    may_be_steps = depth.get("observations", 0) < 2 or any(old == new for old, new in itertools.pairwise(ids))
    if {"episode", "next_observations"} <= depth.keys() and may_be_steps:
        return False
    return depth.get("actions", 0) > 0


def _list_depth(data_type: pa.DataType) -> int:
    """Return how many lists are nested in each row of a column."""
    data_type = getattr(data_type, "storage_type", data_type)  # of an array of fixed shape in a Hugging Face data set
    return 1 + _list_depth(data_type.value_type) if _is_list(data_type) else 0


def _is_text(data_type: pa.DataType) -> bool:
    return pa.types.is_string(data_type) or pa.types.is_large_string(data_type)


def _is_list(data_type: pa.DataType) -> bool:
    tests = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(test(data_type) for test in tests)


def _read_arrays(name: str, table: pa.Table, row_is_episode: bool) -> dict[str, np.ndarray]:
    """Return the columns of an episode as arrays. If rows are steps, its score is that of the last step."""
    arrays = {key: _read_column(name, key, table.column(key)) for key in KEYS if key in table.column_names}
    if row_is_episode:
        return {key: array[0] for key, array in arrays.items()}
    if "score" in arrays:
        arrays["score"] = arrays["score"][-1]
    return arrays


def _read_column(name: str, key: str, column: pa.ChunkedArray) -> np.ndarray:
    """Return a column of numbers (T,), or of nested lists of equal length (T, n, ...). A group may be a text."""
    where = f"{name}: {key}"
    values = column.combine_chunks()
    if isinstance(values, pa.ExtensionArray):  # an array of fixed shape in a Hugging Face data set
        values = values.storage
    if values.null_count:
        raise LareError(f"{where} has rows without a value")
    shape = []
    while _is_list(values.type):
        inner = values.flatten()
        size, remainder = divmod(len(inner), max(len(values), 1))
        lengths = size if pa.types.is_fixed_size_list(values.type) else np.diff(values.offsets.to_numpy())
        if remainder or np.any(lengths != size) or inner.null_count:
            raise LareError(f"{where} must be lists of one length, without gaps")
        shape.append(size)
        values = inner
    if pa.types.is_dictionary(values.type):
        values = values.dictionary_decode()
    if key == "group" and not shape and _is_text(values.type):
        return np.array(values.to_pylist())
    if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type) or pa.types.is_boolean(values.type)):
        raise LareError(f"{where} must be numbers, and is {column.type}")
    return values.to_numpy(zero_copy_only=False).reshape(len(column), *shape)


def _replace_rewards(episode: LoggedEpisode, r_hat: np.ndarray, row_is_episode: bool) -> pa.Table:
    """Return the table of an episode with r_hat as rewards, and the original rewards as `paid`."""
    table = episode.contents
    for name, values in (("rewards", r_hat.astype(np.float32)), ("paid", episode.reward)):
        column = pa.array([values] if row_is_episode else values)
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, column)
        else:
            table = table.append_column(name, column)
    return table.replace_schema_metadata(None)
