"""The directories of runs below given places, as in the directory of a sweep."""

from collections.abc import Sequence
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.runs.directory import CONFIG


def run_directories(places: Sequence[Path]) -> list[Path]:
    """The given runs, and the runs in given directories, up to two levels down, in the order of the places.

    A run that is found twice counts once, at its first place. The log that a sweep writes beside the directory of a run is no
    place of its own, so `DIRECTORY/*` may be given.

    Raises:
        LareError: no place is given, or one of them contains no run.
    """
    found: dict[Path, Path] = {}  # by resolved path
    for place in places:
        if place.suffix == ".log" and place.with_suffix("").is_dir():
            continue
        # A name that begins with a dot is the directory of a run that was killed before its directory was complete.
        below = sorted(path.parent for depth in ("", "[!.]*/", "[!.]*/[!.]*/") for path in place.glob(depth + CONFIG))
        if not below:
            hint = "; give the directory of a run (lare-rl compare also reads .csv files: docs/sweeps.md)"
            raise LareError(f"{place} is not a run, and contains none{hint if place.is_file() else ''}")
        for directory in below:
            found.setdefault(directory.resolve(), directory)
    if not found:
        raise LareError("say which runs: no run is given")
    return list(found.values())
