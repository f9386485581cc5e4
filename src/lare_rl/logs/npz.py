"""A directory of .npz files, one for each episode."""

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from lare_rl.errors import LareError, short_repr
from lare_rl.logs.episode import RelabelledEpisode
from lare_rl.logs.log import Log
from lare_rl.logs.output import atomic_output
from lare_rl.tasks.spec import TaskSpec

__all__ = ["NpzLog", "read_npz", "write_npz_directory"]


class NpzLog(Log):
    """Files in the order of their names. Arrays with other names than those of `parse_episode` are copied unchanged."""

    def __init__(self, directory: Path, role: TaskSpec | None):
        self.name, self.files = str(directory), sorted(directory.glob("*.npz"))
        if not self.files:
            raise LareError(f"{directory} holds no .npz and no .parquet files")
        self.n_episodes = len(self.files)
        self.layout = self.infer_layout(role)

    def read(self) -> Iterator[tuple[str, dict[str, np.ndarray], dict[str, np.ndarray]]]:
        for file in self.files:
            arrays = read_npz(file)
            yield str(file), arrays, arrays

    def write(self, out: str | Path, episodes: Iterable[RelabelledEpisode], overwrite: bool, comment: str) -> Path:
        return write_npz_directory(out, ((Path(item.episode.name).name, item) for item in episodes), overwrite)


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file, without unpickling anything. Raises `LareError` if the file is damaged."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except Exception as error:  # NumPy and zipfile may raise anything for an untrusted file
        raise LareError(f"{file} is not an .npz file, or damaged: {short_repr(error)}") from error


def write_npz_directory(out: str | Path, episodes: Iterable[tuple[str, RelabelledEpisode]], overwrite: bool) -> Path:
    """Write a directory of episodes, each with the name of its file."""
    with atomic_output(Path(out), overwrite) as directory:
        directory.mkdir()
        for name, (episode, r_hat) in episodes:
            _save_npz(directory / name, {**episode.contents, "rewards": r_hat, "paid": episode.reward})
    return Path(out)


def _save_npz(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays of any name. `numpy.savez` cannot save an array whose name is one of its arguments."""
    with zipfile.ZipFile(file, "x", allowZip64=True) as archive:
        for key, array in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
