"""Where logs come from: a Minari or Hugging Face data set, a directory of .npz files, Parquet, or arrays."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lare.errors import LareError, shortened
from lare.logs.episode import Form, Hints, Logged, Paid
from lare.tasks.spec import TaskSpec, the_role


@runtime_checkable
class Source(Protocol):
    """A log that can be read more than once. It is never held in memory as a whole, unless it was given so."""

    name: str
    """For messages."""
    form: Form
    count: int | None
    """Of its episodes, where that is known."""

    def episodes(self) -> Iterator[Logged]:
        """All of them, in order. Raises `LareError` at the first one that is damaged."""
        ...

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Raise `LareError` where nothing can be written there."""
        ...

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write the same log with new rewards, and the old ones as `paid`. Whole or not at all; gives where it is.

        Args:
            out: a path, or an id.
            episodes: in order. They are consumed as they are written.
            overwrite: what is there.
            about: a sentence on what was done, where there is a place for one.
        """
        ...


def hints_of(task: TaskSpec | None) -> Hints:
    """Nothing, where there is no task."""
    if task is None:
        return Hints({}, None)
    role = the_role(task)
    return Hints({"observation": role.observation_size, "action": role.action_size}, role.max_episode_steps)


def open_logs(source: Any, task: TaskSpec | None = None) -> Source:
    """A log by its path, its Minari id, or itself.

    Args:
        source: a directory of .npz or Parquet files, a Parquet file, a Hugging Face data set on the disk, a Minari id or data set,
            flat arrays by name (as D4RL has them), or a list of episodes, each a mapping of arrays.
        task: says of how many choices whole numbers are, and the time limit.

    Raises:
        LareError: it is not there, is no log, or its first episode is damaged.
    """
    hints = hints_of(task)
    if isinstance(source, Mapping):
        from lare.logs.arrays import FlatLogs

        return FlatLogs(source, hints)
    if hasattr(source, "iterate_episodes"):
        from lare.logs.minari import MinariLogs

        return MinariLogs(source, hints)
    if isinstance(source, str | Path):
        return open_path(source, hints)
    if isinstance(source, Iterable) and not isinstance(source, bytes):
        from lare.logs.arrays import ListedLogs

        return ListedLogs(source, hints)
    raise LareError(f"{shortened(source)} is no log: give a path, a Minari id, arrays by name, or a list of episodes")


def open_path(source: str | Path, hints: Hints) -> Source:
    """A log by its path, or a Minari id."""
    path = Path(source)
    if path.is_file() or any(path.glob("*.parquet")):
        from lare.logs.parquet import PARQUET
        from lare.logs.tables import TableLogs

        return TableLogs(path, hints, PARQUET)
    if any((path / name).exists() for name in ("state.json", "dataset_dict.json")):
        from lare.logs.huggingface import HUGGING_FACE
        from lare.logs.tables import TableLogs

        return TableLogs(path, hints, HUGGING_FACE)
    if path.is_dir():
        from lare.logs.npz import NpzLogs

        return NpzLogs(path, hints)
    if isinstance(source, Path) or source.endswith((".parquet", "/")):
        raise LareError(f"there is no {source}")
    from lare.logs.minari import MinariLogs, load

    return MinariLogs(load(source), hints)
