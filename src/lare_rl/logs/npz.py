"""A directory of .npz files, one for each episode."""

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from lare_rl.errors import LareError, shortened
from lare_rl.logs.episode import Hints, Logged, Paid, checked, form_of
from lare_rl.logs.output import check_free, whole


class NpzLogs:
    """Files in the order of their names. The arrays have the names of `episode.checked`; other arrays are kept unchanged."""

    def __init__(self, directory: Path, hints: Hints):
        self.name, self.files = str(directory), sorted(directory.glob("*.npz"))
        if not self.files:
            raise LareError(f"{directory} holds no .npz and no .parquet files")
        self.count: int | None = len(self.files)
        self.form = form_of(str(self.files[0]), read(self.files[0]), hints.sizes, hints.limit)

    def episodes(self) -> Iterator[Logged]:
        """The episodes, one from each file."""
        for file in self.files:
            values = read(file)
            yield checked(str(file), values, self.form, (file.name, values))

    def check_out(self, out: str | Path, overwrite: bool) -> None:
        """Check the directory to write."""
        check_free(Path(out), overwrite)

    def write(self, out: str | Path, episodes: Iterable[Paid], overwrite: bool, about: str) -> str | Path:
        """Write a directory of files with the same names."""
        return write(Path(out), ((paid.episode.kept[0], paid) for paid in episodes), overwrite)


def read(file: Path) -> dict[str, np.ndarray]:
    """The arrays of a file. Raises `LareError` if it is damaged; nothing is unpickled."""
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as saved:
            return {key: saved[key] for key in saved.files}
    except Exception as error:  # NumPy and zipfile may raise anything for a file that is not trusted
        raise LareError(f"{file} is no .npz file, or a damaged one: {shortened(error)}") from error


def write(out: Path, episodes: Iterable[tuple[str, Paid]], overwrite: bool) -> Path:
    """Write a directory of episodes, given with the names of their files."""
    with whole(out, overwrite) as new:
        new.mkdir()
        for name, (episode, r_hat) in episodes:
            values = episode.kept if isinstance(episode.kept, Mapping) else episode.kept[1]
            save(new / name, {**values, "rewards": r_hat, "paid": episode.paid})
    return out


def save(file: Path, values: Mapping[str, np.ndarray]) -> None:
    """Like `numpy.savez`, which cannot save an array whose name is one of its own arguments."""
    with zipfile.ZipFile(file, "x", allowZip64=True) as archive:
        for key, value in values.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)
