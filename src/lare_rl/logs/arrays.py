"""Logs in memory: flat arrays, as in D4RL and CORL, or one mapping of arrays for each episode."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.errors import LareError, short_repr
from lare_rl.logs.episode import KEYS, RelabelledEpisode
from lare_rl.logs.log import Log
from lare_rl.logs.npz import write_npz_directory
from lare_rl.tasks.spec import TaskSpec

__all__ = ["FlatLog", "ListLog"]

D4RL_NAMES = {"terminals": "terminations", "timeouts": "truncations"}
"""Names of flags in D4RL's data sets, and the names here."""


class ListLog(Log):
    """An iterable of mappings, which can be iterated more than once. One episode is read at a time."""

    name = "the list of episodes"

    def __init__(self, episodes: Iterable[Any], role: TaskSpec | None):
        if iter(episodes) is episodes:
            raise LareError("a log is read twice: give a list, or an object whose __iter__ starts again")
        self.list = episodes
        self.n_episodes = len(episodes) if hasattr(episodes, "__len__") else None  # pyright: ignore[reportArgumentType]
        self.layout = self.infer_layout(role)

    def read(self) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
        for number, arrays in enumerate(self.list):
            if not isinstance(arrays, Mapping):
                raise LareError(f"episode {number} must be a mapping of arrays, and is {short_repr(arrays)}")
            yield f"episode {number}", arrays, arrays

    def write(self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str) -> Path:
        """Write a directory of .npz files."""
        return write_npz_directory(
            out, ((f"{number:08d}.npz", item) for number, item in enumerate(episodes)), overwrite
        )


class FlatLog(ListLog):
    """Arrays of all steps. A flag marks the end of an episode. Steps after the last flag are an episode that was cut."""

    def __init__(self, arrays: Mapping[str, Any], role: TaskSpec | None):
        flat = {D4RL_NAMES.get(key, key): np.asarray(value) for key, value in arrays.items()}
        missing = [key for key in ("observations", "next_observations", "actions", "rewards") if key not in flat]
        if missing:
            raise LareError(
                f"flat arrays need observations, next_observations, actions and rewards: {missing[0]} is missing"
            )
        flags = [flat[key] for key in D4RL_NAMES.values() if key in flat]
        if not flags:
            raise LareError("flat arrays need terminations or truncations, which mark the ends of episodes")
        n_steps = len(np.atleast_1d(flat["actions"]))
        # Arrays without a row for each step (D4RL's metadata) belong to no episode.
        flat = {key: value for key, value in flat.items() if key in KEYS or np.shape(value)[:1] == (n_steps,)}
        for key, value in flat.items():
            if np.shape(value)[:1] != (n_steps,):
                raise LareError(
                    f"{key} must have {n_steps} rows, as many as actions, and its shape is {np.shape(value)}"
                )
        is_end = np.any([array.astype(bool).reshape(n_steps, -1).any(axis=1) for array in flags], axis=0)
        is_end[-1:] = True
        super().__init__(_FlatEpisodes(flat, np.flatnonzero(is_end) + 1), role)


class _FlatEpisodes:
    """The episodes of flat arrays, without a copy."""

    def __init__(self, arrays: Mapping[str, np.ndarray], ends: np.ndarray):
        self.arrays, self.ends = arrays, ends.tolist()

    def __len__(self) -> int:
        return len(self.ends)

    def __iter__(self) -> Iterator[Mapping[str, np.ndarray]]:
        for start, end in zip([0, *self.ends], self.ends, strict=False):
            yield {key: value[start:end] for key, value in self.arrays.items()}
