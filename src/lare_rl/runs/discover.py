"""Finds the directories of runs, as in the directory of a sweep."""

from collections.abc import Sequence
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.runs.config_file import CONFIG

__all__ = ["find_run_directories"]


def find_run_directories(paths: Sequence[Path]) -> list[Path]:
    """Return the runs among some paths and up to two levels below them, in the order of the paths.

    A run that is found twice counts once, at its first path. The log that a sweep writes next to the directory of a run is
    skipped, so `DIRECTORY/*` may be passed.

    Raises:
        LareError: there is no path, or one of them contains no run.
    """
    directories: dict[Path, Path] = {}  # by resolved path
    for path in paths:
        if path.suffix == ".log" and path.with_suffix("").is_dir():
            continue
        # A name that begins with a dot is the directory of a run that was killed before it was complete.
        configs = [config for depth in ("", "[!.]*/", "[!.]*/[!.]*/") for config in path.glob(depth + CONFIG)]
        if not configs:
            hint = "; give the directory of a run (lare-rl compare also reads .csv files: docs/sweeps.md)"
            raise LareError(f"{path} is not a run, and contains none{hint if path.is_file() else ''}")
        for config in sorted(configs):
            directories.setdefault(config.parent.resolve(), config.parent)
    if not directories:
        raise LareError("no runs given")
    return list(directories.values())
