"""Logs by format: Minari and Hugging Face data sets, directories of .npz files, Parquet files, and arrays.

Each format is imported when it is needed, because the libraries of most formats are optional.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.errors import LareError, short_repr
from lare_rl.logs.log import Log, list_files
from lare_rl.tasks.spec import TaskSpec, require_role

__all__ = ["open_log"]


def open_log(source: Any, task: TaskSpec | None = None) -> Log:
    """Open a log by its path, its Minari id, or as an object.

    Args:
        source: as in `relabel`. Flat arrays may have D4RL's names.
        task: has the time limit, the number of choices if observations or actions are whole numbers, and the key of groups in
            the infos of a Minari data set.

    Raises:
        LareError: the log does not exist, is not a log, or its first episode is damaged.
    """
    role = None if task is None else require_role(task)
    if isinstance(source, str | Path):
        try:
            return _open_path(source, role)
        except OSError as error:  # no permission, or a name that is too long
            raise LareError(f"{short_repr(str(source))} cannot be opened: {error.strerror or error}") from error
    if hasattr(source, "iterate_episodes"):
        from lare_rl.logs.minari import MinariLog

        return MinariLog(source, role)
    if isinstance(source, Iterable) and not isinstance(source, bytes | np.ndarray):
        from lare_rl.logs.arrays import FlatLog, ListLog

        return FlatLog(source, role) if isinstance(source, Mapping) else ListLog(source, role)
    raise LareError(f"{short_repr(source)} is not a log: a path, a Minari id, arrays by name, or a list of episodes")


def _open_path(source: str | Path, role: TaskSpec | None) -> Log:
    path = Path(source)
    if path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".txt", ".json", ".jsonl", ".npz"):
        raise LareError(
            f"{path} is not a log: give a Parquet file, or a directory with an .npz file for each episode (docs/reference/logs.md)"
        )
    if path.is_file() or list_files(path, ".parquet"):
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
