"""Checkpoints that stay valid if the process is killed at any moment, at a cost that does not grow with the replay.

    checkpoint/
      rows-0.npz, rows-1.npz, ...   the replay's rows, in the order in which they came; each is written once
      state.npz                     everything else, and the list of the row files in use

Row files are only added. A new `state.npz` is written beside the old one, and then replaces it. So `state.npz` always lists
complete row files. No pickle anywhere.
"""

import contextlib
import json
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np

from lare_rl.errors import LareError, shortened
from lare_rl.util.files import write_atomically
from lare_rl.util.safe_io import read_json

STATE = "state.npz"

REPLAY = ".replay."
"""The part of the state that holds the replay."""

BY_ROW = f"{REPLAY}columns"
"""The part of the replay that is saved by row."""

DAMAGED = (
    *(
        OSError,
        ValueError,
        KeyError,
        EOFError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
        tokenize.TokenError,
    ),
    *(TypeError, IndexError, AttributeError, OverflowError, MemoryError, SyntaxError),
)
"""Errors that may be raised by reading a file that is damaged, or holds something else."""

LARGEST_COUNT = 2**53
"""The largest count in a checkpoint."""


@runtime_checkable
class WithReplay(Protocol):
    """Any training state with a replay: `replay.columns` are arrays of [seeds envs rows ...], which are saved by row.

    `replay.next_row` is the number of rows ever written. Each row is stored at its number modulo the capacity.
    """

    @property
    def replay(self) -> Any: ...

    def _replace(self, **changes: Any) -> Any: ...


Some = TypeVar("Some", bound=WithReplay)
Filled = TypeVar("Filled")


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The arrays of a file, which must not be compressed. A damaged file is closed too, unlike by `numpy.load` alone."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
        if not isinstance(saved, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        check_stored(file)
        yield saved


def check_stored(file: Any) -> None:
    """Raise `ValueError` if an archive has a packed entry, because a few bytes can unpack to gigabytes."""
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{entry.filename} is packed, which no checkpoint is")


def counted(value: Any) -> Any:
    """A count, or nested lists of counts, unchanged. Raises `ValueError` for anything else."""
    if isinstance(value, list):
        return [counted(one) for one in value]
    if type(value) is not int or not 0 <= value <= LARGEST_COUNT:
        raise ValueError(f"{shortened(value)} is not a count")
    return value


def read_host(text: Any) -> dict[str, Any]:
    """The other data of a checkpoint, from JSON. Raises `ValueError` if they are not valid."""
    host = read_json(str(text))
    if not isinstance(host, dict):
        raise ValueError("host is no object")
    counted([host[name] for name in ("step", "metrics_length", "functions_since") if name in host])
    digests = host.get("function_sha256", [])
    if not (isinstance(digests, list) and all(isinstance(one, str) for one in digests)):
        raise ValueError("function_sha256 is no list of texts")
    return host


def read_segments(text: Any) -> list[dict[str, Any]]:
    """The list of the row files in use. Raises `ValueError` like `read_host`."""
    return [{name: counted(one[name]) for name in ("number", "start", "count")} for one in read_json(str(text))]


def named_leaves(learner: Any) -> dict[str, Any]:
    """Every array of the state by its path, except the arrays that are saved by row."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(learner)
    named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    return {name: leaf for name, leaf in named.items() if not name.startswith(BY_ROW)}


@jax.jit
def take(columns: dict[str, jax.Array], index: jax.Array) -> dict[str, jax.Array]:
    """Rows of every environment of every seed."""
    of_env = jax.vmap(jax.vmap(lambda rows, where: rows[where]))
    return {name: of_env(column, index) for name, column in columns.items()}


def save(
    directory: Path,
    learner: WithReplay,
    host: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    anew: bool = False,
) -> None:
    """Write a checkpoint.

    Args:
        host: other data to save, as JSON.
        arrays: other data to save, as arrays.
        anew: whether rows that were saved before have changed, so that all rows are saved again.
    """
    directory.mkdir(exist_ok=True)
    for left in directory.glob("*.new"):  # by a process that was killed while it wrote
        left.unlink(missing_ok=True)
    buffer, rows = learner.replay, capacity(learner)
    end = np.asarray(buffer.next_row)
    start, segments, old = np.zeros_like(end), [], []
    if (directory / STATE).exists():
        with opened(directory / STATE) as saved:
            start, segments = saved[".replay.next_row"], read_segments(saved["segments"])
    number = segments[-1]["number"] + 1 if segments else 0
    if anew:
        start, segments, old = np.maximum(end - rows + 1, 0), [], segments
    # The last saved row is saved again, because it held only the newest observation then. And if an episode has just
    # been dropped, `end` is smaller than before.
    start = np.minimum(start, end)
    count = end - start + 1
    width = 1 << int(count.max() - 1).bit_length()  # few widths, few compilations
    taken = take(buffer.columns, (start[..., None] + np.arange(width)) % rows)
    segment = {name: np.asarray(values)[:, :, : count.max()] for name, values in taken.items()}
    write_atomically(directory / f"rows-{number}.npz", lambda file: np.savez(file, allow_pickle=False, **segment))
    segments.append({"number": number, "start": start.tolist(), "count": count.tolist()})
    alive = [one for one in segments if np.any(np.add(one["start"], one["count"]) > end - rows)]
    state = {name: np.asarray(leaf) for name, leaf in named_leaves(learner).items()} | dict(arrays)
    state |= {"host": np.array(json.dumps(host)), "segments": np.array(json.dumps(alive))}
    write_atomically(directory / STATE, lambda file: np.savez(file, allow_pickle=False, **state))
    for one in old + segments:
        if one not in alive:  # not always the oldest ones: a segment from before a drop may reach further
            (directory / f"rows-{one['number']}.npz").unlink(missing_ok=True)


def capacity(learner: WithReplay) -> int:
    """Rows of each environment."""
    return next(iter(learner.replay.columns.values())).shape[2]


def load(directory: Path, template: Some) -> tuple[Some, dict[str, Any], dict[str, np.ndarray]]:
    """Read a checkpoint into a learner of the structure of `template` (whose leaves may be only shapes).

    Returns the learner, and `host` and `arrays` as saved.

    Raises:
        LareError: there is no checkpoint, or it has another structure.
    """
    path = directory / STATE
    if not path.is_file():
        raise LareError(f"there is no checkpoint in {directory}")
    try:
        with opened(path) as saved:
            state = {name: saved[name] for name in saved.files}
        host, segments = read_host(state.pop("host")), read_segments(state.pop("segments"))
        learner = with_rows(fill(template, state), directory, segments)
    except DAMAGED as error:
        raise LareError(f"the checkpoint {path} cannot be read: {error or type(error).__name__}") from error
    return learner, host, {name: array for name, array in state.items() if not name.startswith(".")}


def saved_host(directory: Path) -> dict[str, Any] | None:
    """The `host` of the last checkpoint; None if there is none that can be read."""
    try:
        with opened(directory / STATE) as saved:
            return read_host(saved["host"])
    except DAMAGED:
        return None


def fill(template: Filled, state: Mapping[str, np.ndarray]) -> Filled:
    """The template with the saved arrays for its leaves. A leaf that is a NumPy array stays one, and may have 64 bits.

    Raises `ValueError` where a shape or a type differs, `KeyError` where an array is missing.
    """
    known = named_leaves(template)
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    filled = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path)
        if name not in known:
            filled.append(leaf)
            continue
        array = grown(state[name], leaf.shape) if name.startswith(REPLAY) else state[name]
        if array.shape != leaf.shape:
            raise ValueError(f"{name} has shape {array.shape}, not {leaf.shape}")
        if array.dtype != leaf.dtype:
            raise ValueError(f"{name} holds {array.dtype}, not {leaf.dtype}")
        filled.append(array if isinstance(leaf, np.ndarray) else jax.device_put(array))
    return jax.tree.unflatten(structure, filled)


def grown(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """An array of a smaller replay, padded with zeros at the end; any other array unchanged.

    A run that was extended may have a larger replay. The smaller one had room for every step, so that its rows have the same
    places in the larger one.
    """
    seeds_envs, rows, rest = array.shape[:2], array.shape[2:3], array.shape[3:]
    if not rows or (seeds_envs, rest) != (shape[:2], shape[3:]) or rows > shape[2:3]:
        return array
    behind = np.zeros((*seeds_envs, shape[2] - rows[0], *rest), array.dtype)
    return np.concatenate([array, behind], axis=2)


def with_rows(learner: Some, directory: Path, segments: list[dict[str, Any]]) -> Some:
    rows, columns = capacity(learner), dict(learner.replay.columns)
    for name, column in columns.items():  # one after the other, so that only one of them is in memory twice
        buffer = np.zeros(column.shape, column.dtype)
        for segment in segments:
            with opened(directory / f"rows-{segment['number']}.npz") as saved:
                values = saved[name]
            counts = np.asarray(segment["count"])
            for place in np.ndindex(counts.shape):
                # Of a segment longer than the buffer only the end is left, as in the buffer itself.
                first, count = int(np.asarray(segment["start"])[place]), int(counts[place])
                where = np.arange(first, first + count)[-rows:]
                buffer[(*place, where % rows)] = values[place][:count][-rows:]
        columns[name] = jax.device_put(buffer)
    return learner._replace(replay=learner.replay._replace(columns=columns))
