"""Episodes in memory: flat arrays, as in D4RL and CORL, or one mapping of arrays for each episode."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.errors import LareError, shortened
from lare_rl.logs import npz
from lare_rl.logs.episode import KEYS, NEEDED, Hints, Logged, Paid, checked, form_of
from lare_rl.logs.output import check_free

D4RL = {"terminals": "terminations", "timeouts": "truncations"}
"""From the names of flags in D4RL's data sets to the names here."""


class ListedLogs:
    """Any iterable of mappings that can be iterated more than once. One episode is read at a time."""

    def __init__(self, episodes: Iterable[Mapping[str, Any]], hints: Hints):
        self.name, self.given = "episodes", episodes
        self.count: int | None = len(episodes) if hasattr(episodes, "__len__") else None  # pyright: ignore[reportArgumentType]
        if iter(episodes) is episodes:
            raise LareError("episodes are read twice: give a list, or an object whose __iter__ begins anew")
        first = next(iter(episodes), None)
        if first is None:
            raise LareError("there is no episode")
        self.form = form_of("episode 0", mapping("episode 0", first), hints.sizes, hints.limit)

    def episodes(self) -> Iterator[Logged]:
        """All episodes, in their order."""
        for number, values in enumerate(self.given):
            name = f"episode {number}"
            yield checked(name, mapping(name, values), self.form, values)

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Check the directory to write."""
        check_free(Path(out), overwrite)

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write a directory of .npz files."""
        return npz.write(Path(out), ((f"{number:08d}.npz", paid) for number, paid in enumerate(episodes)), overwrite)


class FlatLogs(ListedLogs):
    """Arrays of all steps, one after the other. A flag marks the end of an episode; steps after the last flag were cut off."""

    def __init__(self, arrays: Mapping[str, Any], hints: Hints):
        flat = {D4RL.get(key, key): np.asarray(value) for key, value in arrays.items()}
        for key in ("observations", "actions", "rewards"):
            if key not in flat:
                raise LareError(
                    f"the arrays have no {key}: flat arrays need observations, actions, rewards and flags of ends"
                )
        steps = len(np.atleast_1d(flat["actions"]))
        if not {"terminations", "truncations"} & set(flat):
            raise LareError("the arrays have no terminations and no truncations: nothing says where episodes end")
        if "next_observations" not in flat:
            raise LareError("the arrays have no next_observations: flat arrays need the observation after each step")
        # Arrays without a row for each step (D4RL's metadata) belong to no episode.
        self.flat = {key: value for key, value in flat.items() if key in KEYS or np.shape(value)[:1] == (steps,)}
        for key, value in self.flat.items():
            if np.shape(value)[:1] != (steps,):
                raise LareError(f"{key} must have {steps} rows, as many as actions, and its shape is {np.shape(value)}")
        ends = [
            np.asarray(self.flat[key]).astype(bool).reshape(steps, -1).any(axis=1)
            for key in D4RL.values()
            if key in flat
        ]
        self.ends = np.flatnonzero(np.logical_or.reduce(ends)) + 1
        if steps and (not len(self.ends) or self.ends[-1] != steps):
            self.ends = np.append(self.ends, steps)
        super().__init__(Pieces(self.flat, self.ends), hints)


class Pieces:
    """The episodes of flat arrays, without a copy."""

    def __init__(self, flat: Mapping[str, np.ndarray], ends: np.ndarray):
        self.flat, self.ends = flat, ends

    def __len__(self) -> int:
        return len(self.ends)

    def __iter__(self) -> Iterator[Mapping[str, np.ndarray]]:
        start = 0
        for end in self.ends.tolist():
            yield {key: value[start:end] for key, value in self.flat.items()}
            start = end


def mapping(name: str, values: Any) -> Mapping[str, Any]:
    """The arrays of an episode by name."""
    if not isinstance(values, Mapping):
        raise LareError(f"{name} must be arrays by name, and is {shortened(values)}: {NEEDED}")
    return values
