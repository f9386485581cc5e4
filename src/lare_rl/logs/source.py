"""Sources of logs: a Minari or Hugging Face data set, a directory of .npz files, Parquet, or arrays."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lare_rl.errors import LareError, shortened
from lare_rl.logs.episode import Form, Hints, Logged, Paid
from lare_rl.tasks.spec import TaskSpec, the_role


@runtime_checkable
class Source(Protocol):
    """A log that can be read more than once. It is not held in memory as a whole, unless it was given as arrays."""

    name: str
    """For messages."""
    form: Form
    count: int | None
    """The number of episodes, if it is known."""

    def episodes(self) -> Iterator[Logged]:
        """All episodes, in order. Raises `LareError` at the first one that is damaged."""
        ...

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Raise `LareError` if `out` cannot be written."""
        ...

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write the same log with new rewards, and the old ones as `paid`, whole or not at all. Returns its path or id.

        Args:
            out: a path, or an id.
            episodes: the episodes in order. They are consumed as they are written.
            overwrite: replace `out` if it exists.
            about: a sentence on what was done, for formats that store a description.
        """
        ...


def hints_of(task: TaskSpec | None) -> Hints:
    """The hints that a task gives; empty without a task."""
    if task is None:
        return Hints({}, None)
    role = the_role(task)
    return Hints({"observation": role.observation_size, "action": role.action_size}, role.max_episode_steps)


def open_logs(source: Any, task: TaskSpec | None = None) -> Source:
    """Open a log, given by its path, by its Minari id, or as an object.

    Args:
        source: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, a Minari id or data set,
            flat arrays by name (as in D4RL), or a list of episodes, each a mapping of arrays.
        task: gives the time limit, and the number of choices if observations or actions are whole numbers.

    Raises:
        LareError: the log does not exist, is not a log, or its first episode is damaged.
    """
    hints = hints_of(task)
    if isinstance(source, Mapping):
        from lare_rl.logs.arrays import FlatLogs

        return FlatLogs(source, hints)
    if hasattr(source, "iterate_episodes"):
        from lare_rl.logs.minari import MinariLogs

        return MinariLogs(source, hints)
    if isinstance(source, str | Path):
        return open_path(source, hints)
    if isinstance(source, Iterable) and not isinstance(source, bytes):
        from lare_rl.logs.arrays import ListedLogs

        return ListedLogs(source, hints)
    raise LareError(f"{shortened(source)} is no log: give a path, a Minari id, arrays by name, or a list of episodes")


def open_path(source: str | Path, hints: Hints) -> Source:
    """A log by its path, or a Minari id."""
    path = Path(source)
    if path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".txt", ".json", ".jsonl"):
        raise LareError(f"{path} is text, which is not read: write the log as .npz or Parquet (docs/logs.md, Formats)")
    if path.is_file() or any(path.glob("*.parquet")):
        from lare_rl.logs.parquet import PARQUET
        from lare_rl.logs.tables import TableLogs

        return TableLogs(path, hints, PARQUET)
    if any((path / name).exists() for name in ("state.json", "dataset_dict.json")):
        from lare_rl.logs.huggingface import HUGGING_FACE
        from lare_rl.logs.tables import TableLogs

        return TableLogs(path, hints, HUGGING_FACE)
    if path.is_dir():
        from lare_rl.logs.npz import NpzLogs

        return NpzLogs(path, hints)
    if isinstance(source, Path) or source.endswith((".parquet", "/")):
        raise LareError(f"there is no {source}")
    try:
        from lare_rl.logs.minari import MinariLogs, load
    except LareError as missing:
        raise LareError(
            f"there is no file or directory {source}. If it is the id of a data set, {missing}"
        ) from missing
    return MinariLogs(load(source), hints)
