"""Checkpoints that stay valid if the process is killed at any moment. Only new rows of the replay are written.

    checkpoint/
      rows-0.npz, rows-1.npz, ...   the replay's rows, from old to new
      state.npz                     everything else, and the list of the row files in use
      best.npz                      the best policies (`best_policy.py`)

A row file never changes. It is deleted when no row of it is in the replay any more. A new `state.npz` replaces the old file when it is
complete. So `state.npz` always lists complete row files. No file contains a pickle.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from lare_rl.errors import LareError, short_repr
from lare_rl.runs.metrics_file import is_count
from lare_rl.util.files import make_directory, remove_partial_files, replace_npz
from lare_rl.util.npz import DAMAGED_FILE_ERRORS, open_npz, report_damage
from lare_rl.util.renamed_fields import rename_fields
from lare_rl.util.rows import padded_size
from lare_rl.util.safe_io import read_json, read_json_object

__all__ = ["STATE_FILE", "fill_template", "load", "named_leaves", "read_metadata", "take_snapshot", "write"]

STATE_FILE = "state.npz"
METADATA, ROW_FILES = "host", "segments"
"""The names in `state.npz` of the metadata and of the list of row files, both in JSON. The names of a state's arrays begin with a dot.
Both values are old words, kept so that files of all versions can be read: they are not the host and the segments of the glossary."""
REPLAY = ".replay."
"""The path of the replay within the state."""
SAVED_BY_ROW = f"{REPLAY}columns"
"""The path of the arrays that are saved by row."""
FILL_IF_MISSING = {
    **dict.fromkeys((".closed_form.strengths.", ".closed_form.intercept", ".closed_form.start_value"), 0),
    **dict.fromkeys((".target_scale", ".log_odds.lowest", ".log_odds.highest"), 0),
    **dict.fromkeys((".is_log_odds", ".is_average", ".predictions.level", ".score_type_predictions.level"), 0),
    ".closed_form.before_end.": 1,
}
"""Paths of arrays that earlier checkpoints do not have, and what fills them. Zeros mean that they have not been computed yet, or make no
difference; the ones, that all inputs vary before the end of an episode, until the sums are rebuilt."""
ZERO_IF_GROUP_IS_MISSING = ".statistics.", ".return_scale.", ".predictions."
"""Paths of groups of arrays that earlier checkpoints do not have if the method fits nothing."""

State = TypeVar("State")
"""A training state with a replay: `replay.columns` are arrays of [seeds envs rows ...], which are saved by row.

`replay.next_row` is the number of the row of the next step, which may hold an observation already. It falls when an episode is dropped.
Rows are stored as in `data/replay.py`.
"""


@dataclass(frozen=True)
class _RowFile:
    """A file of rows."""

    number: int
    """The number in the file's name."""
    start: list[Any]
    """The number of the first row, of each environment of each seed."""
    count: list[Any]
    """The number of rows, of each environment of each seed."""

    @property
    def filename(self) -> str:
        return f"rows-{self.number}.npz"


class Snapshot(NamedTuple):
    """The files that a checkpoint adds and replaces, as NumPy arrays that nothing else changes."""

    row_file: str
    """The name of the new row file."""
    rows: dict[str, np.ndarray]
    state: dict[str, np.ndarray]
    used_files: set[str]
    """The names of the row files in use."""


def take_snapshot(
    directory: Path, learner: Any, metadata: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> Snapshot:
    """Copy from the device what the next checkpoint saves. Call this only after the last checkpoint has been written.

    Args:
        metadata: other data to save as JSON, with the number of the `step`.
        arrays: other data to save, as arrays. Their names must not begin with a dot, or be `METADATA` or `ROW_FILES`.
    """
    # The next step's row is the newest one with an observation.
    capacity, newest_row = _capacity(learner), np.asarray(learner.replay.next_row)
    start, row_files = np.zeros_like(newest_row), []
    if (directory / STATE_FILE).exists():
        with open_npz(directory / STATE_FILE) as saved:
            start, row_files = saved[f"{REPLAY}next_row"], _parse_row_files(saved[ROW_FILES])
    # The last saved row is saved again: it held only an observation, and may hold a whole step now. If an episode has just been
    # dropped, `newest_row` is smaller than before. If there are more new rows than the capacity, only the last of them are stored.
    start = np.minimum(np.maximum(start, newest_row - capacity + 1), newest_row)
    count = newest_row - start + 1
    width = padded_size(int(count.max()))
    rows = _gather_rows(learner.replay.columns, (start[..., None] + np.arange(width)) % capacity)
    newest = _RowFile(row_files[-1].number + 1 if row_files else 0, start.tolist(), count.tolist())
    row_files.append(newest)
    in_use = [
        row_file for row_file in row_files if np.any(np.add(row_file.start, row_file.count) > newest_row - capacity)
    ]
    state = {name: np.array(leaf) for name, leaf in named_leaves(learner).items()}
    state |= {name: np.array(array) for name, array in arrays.items()}
    state[METADATA] = np.array(json.dumps(metadata))
    state[ROW_FILES] = np.array(json.dumps([asdict(row_file) for row_file in in_use]))
    return Snapshot(
        row_file=newest.filename,
        rows={name: np.array(values[:, :, : count.max()]) for name, values in jax.device_get(rows).items()},
        state=state,
        # A file from before a dropped episode may hold higher row numbers than later files, and stay in use longer.
        used_files={row_file.filename for row_file in in_use},
    )


def write(directory: Path, snapshot: Snapshot) -> None:
    """Write a checkpoint. Raises `LareError` if it cannot be written."""
    make_directory(directory)
    for name in ("rows-*", STATE_FILE):
        remove_partial_files(directory / name)
    replace_npz(directory / snapshot.row_file, snapshot.rows)
    replace_npz(directory / STATE_FILE, snapshot.state)
    for path in directory.glob("rows-*.npz"):
        if path.name not in snapshot.used_files:
            path.unlink(missing_ok=True)


def load(directory: Path, template: State) -> tuple[State, dict[str, Any], dict[str, np.ndarray]]:
    """Return a saved training state, and its `metadata` and `arrays`.

    The template is a training state of the same structure, whose leaves may be shapes.

    Raises `LareError` if there is no checkpoint, or it has another structure.
    """
    path = directory / STATE_FILE
    if not path.is_file():
        raise LareError(f"there is no checkpoint in {directory}")
    with report_damage(f"the checkpoint {path} cannot be read"):
        with open_npz(path) as saved:
            state = {name: saved[name] for name in saved.files}
        metadata, row_files = _parse_metadata(state.pop(METADATA)), _parse_row_files(state.pop(ROW_FILES))
        learner = _load_rows(fill_template(template, state), directory, row_files)
    return learner, metadata, {name: array for name, array in state.items() if not name.startswith(".")}


def read_metadata(directory: Path) -> dict[str, Any] | None:
    """Read the `metadata` of the last checkpoint. Return None if there is no checkpoint that can be read."""
    try:
        with open_npz(directory / STATE_FILE) as saved:
            return _parse_metadata(saved[METADATA])
    except DAMAGED_FILE_ERRORS:
        return None


def named_leaves(state: Any) -> dict[str, Any]:
    """Return every array of a state by its path, except the arrays that are saved by row."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    by_path = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    return {name: leaf for name, leaf in by_path.items() if not name.startswith(SAVED_BY_ROW)}


def fill_template(template: State, arrays: Mapping[str, np.ndarray]) -> State:
    """Replace the leaves of a template by saved arrays, whose names may be of an earlier version.

    A NumPy leaf stays a NumPy array, because JAX would cut 64 bits to 32.

    Raises `ValueError` if an array is missing, or if a shape or a type differs.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    arrays = {name if name in names else rename_fields(name): array for name, array in arrays.items()}
    filled = []
    for name, (_, leaf) in zip(names, leaves, strict=True):
        if name.startswith(SAVED_BY_ROW):
            filled.append(leaf)
            continue
        array = arrays.get(name)
        if array is None:
            group = name.rpartition(".")[0] + "."
            is_new_group = group.endswith(ZERO_IF_GROUP_IS_MISSING) and not any(
                other.startswith(group) for other in arrays
            )
            fill = next((value for path, value in FILL_IF_MISSING.items() if path in name), 0 if is_new_group else None)
            if fill is None:
                raise ValueError(f"{name} is missing")
            array = np.full(leaf.shape, fill, leaf.dtype)
        if name.startswith(REPLAY):
            array = _extend_replay(array, leaf.shape)
        if array.shape != leaf.shape:
            raise ValueError(f"{name} has shape {array.shape}, not {leaf.shape}")
        if array.dtype != leaf.dtype:
            raise ValueError(f"{name} holds {array.dtype}, not {leaf.dtype}")
        filled.append(array if isinstance(leaf, np.ndarray) else _put_like(leaf, array))
    return jax.tree.unflatten(structure, filled)


def _extend_replay(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Append zeros to an array of a smaller replay. Return any other array unchanged.

    A run that was extended may have a larger replay. The smaller replay had room for every step, so its rows keep their indices.
    """
    seeds_envs, rows, rest = array.shape[:2], array.shape[2:3], array.shape[3:]
    if not rows or (seeds_envs, rest) != (shape[:2], shape[3:]) or rows > shape[2:3]:
        return array
    zeros = np.zeros((*seeds_envs, shape[2] - rows[0], *rest), array.dtype)
    return np.concatenate([array, zeros], axis=2)


def _load_rows(learner: Any, directory: Path, row_files: list[_RowFile]) -> Any:
    """Return the learner with the saved rows of its replay."""
    capacity, columns = _capacity(learner), dict(learner.replay.columns)
    for name, column in columns.items():  # by column, so that no more than one is in memory twice
        buffer = np.zeros(column.shape, column.dtype)
        for row_file in row_files:
            with open_npz(directory / row_file.filename) as saved:
                values = saved[name]
            starts, counts = np.asarray(row_file.start), np.asarray(row_file.count)
            if values.dtype != column.dtype or values.shape[2] < counts.max():
                raise ValueError(f"{row_file.filename} does not fit")
            for env in np.ndindex(counts.shape):
                # Earlier versions wrote files that are longer than the replay. Only their ends are in use.
                start, count = int(starts[env]), int(counts[env])
                rows = np.arange(start, start + count)[-capacity:]
                buffer[(*env, rows % capacity)] = values[env][:count][-capacity:]
        columns[name] = _put_like(column, buffer)
    return learner._replace(replay=learner.replay._replace(columns=columns))


def _put_like(template: Any, array: np.ndarray) -> jax.Array:
    """Copy an array to the devices of a `ShapeDtypeStruct`, else to JAX's default device."""
    return jax.device_put(array, template.sharding if isinstance(template, jax.ShapeDtypeStruct) else None)


@jax.jit
def _gather_rows(columns: dict[str, jax.Array], rows: jax.Array) -> dict[str, jax.Array]:
    """Return rows of every environment of every seed."""
    read = jax.vmap(jax.vmap(lambda column, env_rows: column[env_rows]))
    return {name: read(column, rows) for name, column in columns.items()}


def _capacity(learner: Any) -> int:
    """Return the number of rows of each environment."""
    return next(iter(learner.replay.columns.values())).shape[2]


def _parse_metadata(text: Any) -> dict[str, Any]:
    """Read the metadata from JSON. Raises one of `DAMAGED_FILE_ERRORS` if they are not valid."""
    metadata = read_json_object(str(text))
    for value in (metadata["step"], metadata.get("metrics_length", 0)):
        if not is_count(value):
            raise ValueError(f"{short_repr(value)} is not a count")
    digests = metadata.get("function_sha256", [])
    if not (isinstance(digests, list) and all(isinstance(digest, str) for digest in digests)):
        raise ValueError("function_sha256 is no list of texts")
    return metadata


def _parse_row_files(text: Any) -> list[_RowFile]:
    """Read the list of row files from JSON. Raises one of `DAMAGED_FILE_ERRORS` if it is not valid."""
    names = ("number", "start", "count")
    return [_RowFile(**{name: _check_counts(values[name]) for name in names}) for values in read_json(str(text))]


def _check_counts(value: Any) -> Any:
    """Return a whole number from 0 to `MAX_INTEGER`, or nested lists of them, unchanged. Raise `ValueError` for anything else."""
    if isinstance(value, list):
        return [_check_counts(element) for element in value]
    if not is_count(value):
        raise ValueError(f"{short_repr(value)} is not a count")
    return value
