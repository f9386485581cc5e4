"""Logs: Minari and Hugging Face data sets, directories of .npz files, Parquet files, and arrays."""

import contextlib
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from lare_rl.errors import LareError, short_repr
from lare_rl.logs.episode import LoggedEpisode, LogLayout, RelabelledEpisode, infer_layout, parse_episode
from lare_rl.tasks.spec import TaskSpec, require_role

__all__ = ["Log", "atomic_output", "batch_by_steps", "check_output", "open_log"]

_Item = TypeVar("_Item")

BATCH_STEPS = 8192
"""The least number of steps whose rewards are computed, or which are written, at a time."""
LOG_SUFFIXES = frozenset({".npz", ".parquet", ".arrow", ".json"})
"""Files of logs. A directory with other files is never replaced."""


class Log(ABC):
    """A log, which is read as a stream, more than once. It is never in memory as a whole, except for a log of arrays."""

    name: str
    """The path or the id, for messages."""
    layout: LogLayout
    n_episodes: int | None = None
    """The number of episodes; None if it is unknown."""

    @abstractmethod
    def read(self) -> Iterator[tuple[str, Mapping[str, Any], Any]]:
        """Yield the name, the arrays and the contents (see `parse_episode`) of each episode, in order."""

    @abstractmethod
    def write(
        self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str
    ) -> str | Path:
        """Write the log with r_hat as rewards, and the original rewards as `paid`, completely or not at all.

        Args:
            out: a path, or an id.
            episodes: the episodes in order. They are consumed as they are written.
            comment: a sentence about the new rewards, for formats with a description.

        Returns:
            The path or the id.
        """

    def episodes(self) -> Iterator[LoggedEpisode]:
        """Yield all episodes, in order. Raises `LareError` at the first damaged one."""
        for name, values, contents in self.read():
            yield parse_episode(name, values, self.layout, contents)

    def check_output(self, out: str | Path, overwrite: bool) -> None:
        """Raise `LareError` if `out` cannot be written."""
        check_output(Path(out), overwrite)

    def infer_layout(self, role: TaskSpec | None) -> LogLayout:
        """Infer the layout from the first episode. Raises `LareError` for an empty log."""
        for name, values, _ in self.read():
            return infer_layout(name, values, role)
        raise LareError(f"{self.name} has no episode")


def batch_by_steps(items: Iterable[_Item], count_steps: Callable[[_Item], int]) -> Iterator[list[_Item]]:
    """Yield lists of successive items with at least `BATCH_STEPS` steps in total, except for the last list."""
    batch, n_steps = [], 0
    for item in items:
        batch.append(item)
        n_steps += count_steps(item)
        if n_steps >= BATCH_STEPS:
            yield batch
            batch, n_steps = [], 0
    if batch:
        yield batch


def open_log(source: Any, task: TaskSpec | None = None) -> Log:
    """Open a log by its path, its Minari id, or as an object.

    Args:
        source: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, a Minari id or data set,
            flat arrays by name (as in D4RL), or a list of episodes, each a mapping of arrays.
        task: has the time limit, and the number of choices if observations or actions are whole numbers.

    Raises:
        LareError: the log does not exist, is not a log, or its first episode is damaged.
    """
    role = None if task is None else require_role(task)
    if isinstance(source, str | Path):
        return _open_path(source, role)
    # Each format is imported when it is needed, because the libraries of most formats are optional.
    if hasattr(source, "iterate_episodes"):
        from lare_rl.logs.minari import MinariLog

        return MinariLog(source, role)
    if isinstance(source, Iterable) and not isinstance(source, bytes):
        from lare_rl.logs.arrays import FlatLog, ListLog

        return FlatLog(source, role) if isinstance(source, Mapping) else ListLog(source, role)
    raise LareError(f"{short_repr(source)} is not a log: a path, a Minari id, arrays by name, or a list of episodes")


def _open_path(source: str | Path, role: TaskSpec | None) -> Log:
    path = Path(source)
    if path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".txt", ".json", ".jsonl"):
        raise LareError(
            f"{path} is text, which cannot be read: write the log as .npz or Parquet (docs/reference/logs.md)"
        )
    if path.is_file() or any(path.glob("*.parquet")):
        from lare_rl.logs.tables import ParquetLog

        return ParquetLog(path, role)
    if any((path / name).exists() for name in ("state.json", "dataset_dict.json")):
        from lare_rl.logs.huggingface import HuggingFaceLog

        return HuggingFaceLog(path, role)
    if path.is_dir():
        from lare_rl.logs.arrays import NpzLog

        return NpzLog(path, role)
    if isinstance(source, Path) or source.endswith((".parquet", "/")):
        raise LareError(f"{source} does not exist")
    try:
        from lare_rl.logs.minari import MinariLog, load_dataset
    except LareError as error:
        raise LareError(f"no file or directory {source} exists. If it is the id of a data set: {error}") from error
    return MinariLog(load_dataset(source), role)


def check_output(out: Path, overwrite: bool, folders: Container[str] = ()) -> None:
    """Raise `LareError` if `out` exists and must not be replaced, or if nothing can be written there.

    `folders` are the names of the directories that a log has. A directory with others is never replaced.
    """
    if out.exists() and not overwrite:
        raise LareError(f"{out} exists: choose another path, or replace it with --overwrite (overwrite=True)")
    if out.is_dir():
        foreign = [
            path.name
            for path in sorted(out.iterdir())
            if (path.name not in folders if path.is_dir() else path.suffix not in LOG_SUFFIXES)
        ]
        if foreign:
            raise LareError(f"{out} cannot be replaced, because {foreign[0]} in it is not a log: choose another path")
    if not out.name or not out.parent.is_dir():
        raise LareError(f"{out} cannot be written: there is no directory {out.parent}")


@contextlib.contextmanager
def atomic_output(out: Path, overwrite: bool, folders: Container[str] = ()) -> Iterator[Path]:
    """Yield a temporary path for a file or a directory. At the end it replaces `out`; after an error it is removed.

    Raises `LareError` if `out` exists, or cannot be written: see `check_output`.
    """
    check_output(out, overwrite, folders)
    new, old = (out.with_name(f".{out.name}.{uuid4().hex}.{kind}") for kind in ("new", "old"))
    try:
        yield new
        check_output(out, overwrite, folders)
        if out.exists():
            out.rename(old)
        new.rename(out)
    except OSError as error:
        raise LareError(f"{out} cannot be written ({error.strerror or error}); existing data are unchanged") from error
    finally:
        if old.exists() and not out.exists():
            old.rename(out)
        for path in (new, old):
            shutil.rmtree(path, ignore_errors=True)  # does nothing for a file or a link
            with contextlib.suppress(OSError):
                path.unlink()
