"""A checkpoint that a kill at any moment leaves whole, at a cost that does not grow with the replay.

    checkpoint/
      rows-0.npz, rows-1.npz, ...   the replay's rows, as they came: each is written once
      state.npz                     everything else, and which of the row files count

A row file is only ever added; `state.npz` is written beside the old one and renamed onto it. Whatever the moment, the
`state.npz` that is there speaks of row files that are whole. No pickle anywhere.
"""

import contextlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from lare.errors import LareError
from lare.files import write_atomically

STATE = "state.npz"

DAMAGED = (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What reading a file that is not whole may raise."""


@runtime_checkable
class WithReplay(Protocol):
    """Any training state with a replay: arrays with a seed axis first and, if they are saved by row, rows behind it.

    `replay.next_row` is the number of rows ever written; they stand at their number modulo the capacity.
    """

    @property
    def replay(self) -> Any: ...

    def _replace(self, **changes: Any) -> Any: ...


Some = TypeVar("Some", bound=WithReplay)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The arrays of a file. NumPy would leave one that is not whole open."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
        yield saved


def named_leaves(learner: Any, by_row: Sequence[str]) -> dict[str, Any]:
    """Every array of the state by its place, but for those that are saved by row."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(learner)
    named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    return {name: leaf for name, leaf in named.items() if name not in {f".replay.{field}" for field in by_row}}


@jax.jit
def take(buffer: jax.Array, index: jax.Array) -> jax.Array:
    return jax.vmap(lambda rows, where: rows[where])(buffer, index)


def save(
    directory: Path,
    learner: WithReplay,
    by_row: Sequence[str],
    host: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a checkpoint.

    Args:
        by_row: the fields of the replay whose rows are written as they come.
        host: what else is to be remembered, as JSON.
        arrays: the same, as arrays.
    """
    directory.mkdir(exist_ok=True)
    for left in directory.glob("*.new"):  # by a process that was killed while it wrote
        left.unlink(missing_ok=True)
    held, rows = learner.replay, learner.replay.reward.shape[1]
    end = np.asarray(held.next_row)
    start, segments = np.zeros_like(end), []
    if (directory / STATE).exists():
        with opened(directory / STATE) as saved:
            start, segments = saved[".replay.next_row"], json.loads(str(saved["segments"]))
    # The frontier row is saved again: it held only the newest observation when it was saved before. And where an
    # episode has just been dropped, the end has come back.
    start = np.minimum(start, end)
    count = end - start + 1
    width = 1 << int(count.max() - 1).bit_length()  # few widths, few compilations
    index = jnp.asarray((start[:, None] + np.arange(width)) % rows)
    segment = {field: np.asarray(take(getattr(held, field), index))[:, : count.max()] for field in by_row}
    number = segments[-1]["number"] + 1 if segments else 0
    write_atomically(directory / f"rows-{number}.npz", lambda file: np.savez(file, allow_pickle=False, **segment))
    segments.append({"number": number, "start": start.tolist(), "count": count.tolist()})
    alive = [one for one in segments if any(np.add(one["start"], one["count"]) > end - rows)]
    state = {name: np.asarray(leaf) for name, leaf in named_leaves(learner, by_row).items()} | dict(arrays)
    state |= {"host": np.array(json.dumps(host)), "segments": np.array(json.dumps(alive))}
    write_atomically(directory / STATE, lambda file: np.savez(file, allow_pickle=False, **state))
    for one in segments:
        if one not in alive:  # which are not always the newest: a segment from before a drop may reach further
            (directory / f"rows-{one['number']}.npz").unlink(missing_ok=True)


def load(directory: Path, template: Some, by_row: Sequence[str]) -> tuple[Some, dict[str, Any], dict[str, np.ndarray]]:
    """Read a checkpoint into a learner of the structure of `template` (whose leaves may be only shapes).

    Returns it, and `host` and `arrays` as saved.

    Raises:
        LareError: there is none, or it is of another structure.
    """
    path = directory / STATE
    if not path.is_file():
        raise LareError(f"there is no checkpoint in {directory}")
    try:
        with opened(path) as saved:
            state = {name: saved[name] for name in saved.files}
        host, segments = json.loads(str(state.pop("host"))), json.loads(str(state.pop("segments")))
        learner = with_rows(fill(template, state, by_row), by_row, directory, segments)
    except DAMAGED as error:
        raise LareError(f"the checkpoint {path} cannot be read: {error}") from error
    return learner, host, {name: array for name, array in state.items() if not name.startswith(".")}


def saved_step(directory: Path) -> int | None:
    """The step of the last checkpoint; None where there is none that can be read."""
    try:
        with opened(directory / STATE) as saved:
            return json.loads(str(saved["host"]))["step"]
    except DAMAGED:
        return None


def fill(template: Some, state: Mapping[str, np.ndarray], by_row: Sequence[str]) -> Some:
    known = named_leaves(template, by_row)
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    filled = []
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path)
        if name in known and state[name].shape != leaf.shape:
            raise ValueError(f"{name} has shape {state[name].shape}, not {leaf.shape}")
        filled.append(jnp.asarray(state[name]) if name in known else leaf)
    return jax.tree.unflatten(structure, filled)


def with_rows(learner: Some, by_row: Sequence[str], directory: Path, segments: list[dict[str, Any]]) -> Some:
    held, rows = learner.replay, learner.replay.reward.shape[1]
    for field in by_row:  # one after the other, so that only one of them is in memory twice
        buffer = np.zeros(getattr(held, field).shape, getattr(held, field).dtype)
        for segment in segments:
            with opened(directory / f"rows-{segment['number']}.npz") as saved:
                values = saved[field]
            for seed, (start, count) in enumerate(zip(segment["start"], segment["count"], strict=True)):
                # Of a stretch longer than the buffer only the end is left, as it was when it was written.
                where = np.arange(start, start + count)[-rows:]
                buffer[seed, where % rows] = values[seed, :count][-rows:]
        held = held._replace(**{field: jnp.asarray(buffer)})
    return learner._replace(replay=held)
