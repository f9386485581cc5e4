"""A log in any format, and output that is written completely or not at all."""

import contextlib
import glob
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from lare_rl.errors import LareError
from lare_rl.logs.episode import LoggedEpisode, LogLayout, RelabelledEpisode, infer_layout, parse_episode
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.files import check_writable, report_write_error

__all__ = ["Log", "atomic_output", "batch_by_steps", "check_output", "list_files"]

_Item = TypeVar("_Item")

BATCH_STEPS = 8192
"""Steps at a time: at least this many are computed or written, and at most this many rows of steps are read."""
ABANDONED_S = 3600.0
"""If incomplete output was not changed for this time (s), its process was killed."""
LOG_SUFFIXES = frozenset({".npz", ".parquet", ".arrow", ".json"})
"""Files of logs. A directory with other files is never replaced."""


class Log(ABC):
    """A log, which is read as a stream, more than once. It is never in memory as a whole, unless its source is in memory."""

    name: str
    """The path or the id, for messages."""
    layout: LogLayout
    n_episodes: int | None = None
    """The number of episodes; None if it is unknown."""
    description: str = ""
    """What its author says of it."""

    @abstractmethod
    def read(self) -> Iterator[tuple[str, Mapping[str, Any], Any]]:
        """Yield the name, the arrays and the contents (all that was read, for `write`) of each episode, in order."""

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


def check_output(out: Path, overwrite: bool, folders: Container[str] = ()) -> None:
    """Raise `LareError` if `out` exists and must not be replaced, or if nothing can be written there.

    `folders` are the names of the directories that may be in `out` (only Minari's format has one). If `out` has any other, it is never
    replaced.
    """
    with report_write_error(out):
        if out.exists() and not overwrite:
            raise LareError(f"{out} exists: choose another path, or replace it with --overwrite (overwrite=True)")
        for path in sorted(out.iterdir()) if out.is_dir() else []:
            is_foreign = path.name not in folders if path.is_dir() else path.suffix not in LOG_SUFFIXES
            if is_foreign:
                raise LareError(
                    f"{out} cannot be replaced, because {path.name} in it is not a log: choose another path"
                )
        if not out.name:
            raise LareError(f"{out} cannot be replaced: give the name of the directory")
        if out.exists() and not (out.is_file() or out.is_dir()):
            raise LareError(f"{out} is a device or a pipe, which is never replaced: choose another path")
        if not out.parent.is_dir():
            raise LareError(f"{out} cannot be written: there is no directory {out.parent}")
        check_writable(out)


def list_files(directory: Path, suffix: str) -> list[Path]:
    """Return the files of a log in the order of their names, without hidden files, such as those in archives of macOS."""
    return sorted(path for path in directory.glob(f"*{suffix}") if path.is_file() and not path.name.startswith("."))


@contextlib.contextmanager
def atomic_output(out: Path, overwrite: bool, folders: Container[str] = ()) -> Iterator[Path]:
    """Yield a temporary path for a file or a directory. At the end it replaces `out`; after an error it is removed.

    Raises `LareError` if `out` exists, or cannot be written: see `check_output`.
    """
    _clean_up(out)
    check_output(out, overwrite, folders)
    new, old = (out.with_name(f".{out.name}.{uuid4().hex}.{kind}") for kind in ("new", "old"))
    try:
        with report_write_error(out, "; existing data are unchanged"):
            yield new
            check_output(out, overwrite, folders)
            # No single call replaces a directory, or a file by a directory.
            if out.is_dir() or (out.exists() and new.is_dir()):
                out.rename(old)
            new.replace(out)
    finally:
        if old.exists() and not out.exists():
            old.rename(out)
        for path in (new, old):
            _remove(path)


def _clean_up(out: Path) -> None:
    """Put back the data that a killed process had moved away. Remove its incomplete output, but not that of a living process."""
    with contextlib.suppress(OSError):
        for path in out.parent.glob(f".{glob.escape(out.name)}.{'[0-9a-f]' * 32}.*"):  # not those of `OUT.b`
            if path.suffix == ".old" and not out.exists():
                path.rename(out)
            elif path.suffix in (".old", ".new") and _is_abandoned(path):
                _remove(path)


def _is_abandoned(path: Path) -> bool:
    """Return whether nothing in `path` was changed for so long that no living process writes it."""
    changed = max(file.stat().st_mtime for file in (path, *path.rglob("*")))
    return time.time() - changed > ABANDONED_S


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)  # does nothing for a file or a link
    with contextlib.suppress(OSError):
        path.unlink()
