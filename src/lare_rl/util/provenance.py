"""The version of this code, which is saved with every result."""

import functools
import subprocess
from pathlib import Path

from lare_rl._version import __version__


@functools.cache
def source(directory: Path = Path(__file__).parents[1]) -> str:
    """Version of the package; in a checkout also the last commit that touched it, and whether it was changed since.

    If `directory` only lies within another repository, as a virtual environment may, that repository's commits do not count.
    """
    commit = git(directory, "log", "-1", "--format=%h", "--abbrev=10", "--", ".")
    if not commit:
        return __version__
    changed = git(directory, "status", "--porcelain", "--", ".")
    return f"{__version__} ({commit}{', changed' if changed else ''})"


def git(directory: Path, *arguments: str) -> str:
    """The output of git; empty if it fails."""
    try:
        done = subprocess.run(("git", *arguments), cwd=directory, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()
