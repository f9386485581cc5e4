"""Logs of NumPy arrays: directories with an .npz file for each episode, and logs in memory."""

import contextlib
import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.assigner.space_layout import to_array
from lare_rl.errors import LareError, short_repr
from lare_rl.logs.episode import KEYS, RelabelledEpisode
from lare_rl.logs.log import LOG_SUFFIXES, Log, atomic_output, list_files
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.files import write_npz
from lare_rl.util.npz import open_npz

__all__ = ["FlatLog", "ListLog", "NpzLog", "read_npz"]

D4RL_NAMES = {"terminals": "terminations", "timeouts": "truncations"}
"""From the names of flags in D4RL to those of `parse_episode`."""
MAX_EPISODE_BYTES = 8 << 30
"""The largest size of an episode in memory. A few compressed bytes can unpack to gigabytes."""


class ArrayLog(Log):
    """A log whose episodes are mappings of arrays. It is written as a directory of .npz files."""

    def check_output(self, out: str | Path, overwrite: bool) -> None:
        super().check_output(out, overwrite)
        if (suffix := Path(out).suffix) in LOG_SUFFIXES:
            raise LareError(f"{out} cannot be written: this log is written as a directory, so leave out {suffix}")

    def write(self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str) -> Path:
        with atomic_output(Path(out), overwrite) as directory:
            directory.mkdir()
            for number, (episode, r_hat) in enumerate(episodes):
                contents = _without_objects(episode.name, episode.contents)
                arrays = {**contents, "rewards": r_hat, "paid": episode.reward}
                with (directory / self.file_name(number, episode.name)).open("xb") as file:
                    write_npz(file, arrays)
        return Path(out)

    def file_name(self, number: int, name: str) -> str:
        """Return the name of the file of an episode."""
        return f"{number:08d}.npz"


class NpzLog(ArrayLog):
    """Files in the order of their names. Arrays with other names than those of `parse_episode` are copied unchanged."""

    def __init__(self, directory: Path, role: TaskSpec | None):
        self.name, self.files = str(directory), list_files(directory, ".npz")
        if not self.files:
            raise LareError(f"{directory} holds no .npz and no .parquet files")
        self.n_episodes = len(self.files)
        self.layout = self.infer_layout(role)

    def read(self) -> Iterator[tuple[str, dict[str, np.ndarray], dict[str, np.ndarray]]]:
        for file in self.files:
            arrays = read_npz(file)
            yield str(file), arrays, arrays

    def file_name(self, number: int, name: str) -> str:
        return Path(name).name


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file, without unpickling anything. Raises `LareError` if the file is damaged, or holds Python objects."""
    values, key = {}, ""
    try:
        with open_npz(file, MAX_EPISODE_BYTES) as arrays:
            for key in arrays.files:
                values[key] = arrays[key]
    except Exception as error:  # NumPy and zipfile may raise anything for an untrusted file
        if "allow_pickle" in str(error):
            raise LareError(f"{file}: {key} holds Python objects, which are not read: save it without {key}") from error
        raise LareError(f"{file} is not an .npz file, or damaged: {short_repr(error)}") from error
    return values


class ListLog(ArrayLog):
    """An iterable of mappings that can be iterated more than once. One episode is read at a time."""

    name = "the list of episodes"

    def __init__(self, episodes: Iterable[Any], role: TaskSpec | None):
        if iter(episodes) is episodes:
            raise LareError("a log is read twice: give a list, or an object whose __iter__ starts again")
        self.mappings = episodes
        self.n_episodes = len(episodes) if hasattr(episodes, "__len__") else None  # pyright: ignore[reportArgumentType]
        self.layout = self.infer_layout(role)

    def read(self) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
        for number, arrays in enumerate(self.mappings):
            if not isinstance(arrays, Mapping):
                raise LareError(f"episode {number} must be a mapping of arrays, and is {short_repr(arrays)}")
            yield f"episode {number}", arrays, arrays

    def check_output(self, out: str | Path, overwrite: bool) -> None:
        """Raise `LareError` if `out` cannot be written, or if an array of the first episode cannot be saved."""
        super().check_output(out, overwrite)
        for name, arrays, _ in itertools.islice(self.read(), 1):  # reading all may take long
            _without_objects(name, arrays)


def _without_objects(name: str, contents: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of an episode. Texts that are Python objects, as of pandas, become arrays of texts.

    Raises `LareError` for other objects, which are not saved.
    """
    arrays = {}
    for key, value in contents.items():
        with contextlib.suppress(TypeError, ValueError, RuntimeError):  # unequal lengths; objects that do not convert
            array = np.asarray(value)
            arrays[key] = np.array(array.tolist()) if array.dtype.hasobject else array
        if key not in arrays or arrays[key].dtype.hasobject:
            raise LareError(f"{name}: {key} is no array of numbers or texts, but {short_repr(value)}: leave it out")
    return arrays


class FlatLog(ListLog):
    """Arrays of all steps. A flag marks the end of an episode. Steps after the last flag are an episode that was cut."""

    name = "the flat arrays"

    def __init__(self, arrays: Mapping[str, Any], role: TaskSpec | None):
        both = [key for key, name in D4RL_NAMES.items() if key in arrays and name in arrays]
        if both:
            raise LareError(f"flat arrays have {both[0]} and {D4RL_NAMES[both[0]]}: leave one of them out")
        flat = {D4RL_NAMES.get(key, key): _read_flat(key, value) for key, value in arrays.items()}
        reward = "score" if "score" in flat else "rewards"
        missing = [key for key in ("observations", "next_observations", "actions", reward) if key not in flat]
        if missing:
            raise LareError(
                f"flat arrays need observations, next_observations, actions, and rewards or score: {missing[0]} is missing"
            )
        flags = {key: to_array(flat[key], key).ravel() for key in D4RL_NAMES.values() if key in flat}  # (n, 1) too
        if not flags:
            raise LareError("flat arrays need terminations or truncations, which mark the ends of episodes")
        flat |= flags
        n_steps = len(np.atleast_1d(flat["actions"]))
        if not n_steps:
            raise LareError("flat arrays have no step")
        # Arrays without a row for each step (D4RL's metadata) belong to no episode.
        flat = {key: value for key, value in flat.items() if key in KEYS or np.shape(value)[:1] == (n_steps,)}
        for key, value in flat.items():
            if np.shape(value)[:1] != (n_steps,):
                raise LareError(f"{key} must have {n_steps} rows, as many as actions: its shape is {np.shape(value)}")
        is_end = np.any([array.astype(bool) for array in flags.values()], axis=0)
        is_end[-1] = True
        super().__init__(_FlatEpisodes(flat, np.flatnonzero(is_end) + 1), role)


def _read_flat(key: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError:
        raise LareError(f"{key} is {short_repr(value)}: its rows must have one shape") from None


class _FlatEpisodes:
    """The episodes of flat arrays, without a copy."""

    def __init__(self, arrays: Mapping[str, np.ndarray], ends: np.ndarray):
        self.arrays, self.ends = arrays, ends.tolist()

    def __len__(self) -> int:
        return len(self.ends)

    def __iter__(self) -> Iterator[Mapping[str, np.ndarray]]:
        for start, end in zip([0, *self.ends], self.ends, strict=False):
            episode = {key: value[start:end] for key, value in self.arrays.items()}
            # Every row has the score, if there is one, and that of the last row counts.
            yield episode | {"score": episode["score"][-1]} if "score" in episode else episode
