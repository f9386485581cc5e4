"""The version of this code, which is saved with every result."""

import functools
import subprocess
from pathlib import Path

from lare_rl._version import __version__

__all__ = ["code_version"]


@functools.cache
def code_version(directory: Path = Path(__file__).parents[1]) -> str:
    """Return the version of the package; in a checkout also its last commit, and whether the code was changed since.

    Only commits that touch `directory` count: a virtual environment may lie within another repository.
    """
    commit = _git(directory, "log", "-1", "--format=%h", "--abbrev=10", "--", ".")
    if not commit:
        return __version__
    changed = _git(directory, "status", "--porcelain", "--", ".")
    return f"{__version__} ({commit}{', changed' if changed else ''})"


def _git(directory: Path, *arguments: str) -> str:
    """Return the output of git, or an empty text if it fails."""
    try:
        process = subprocess.run(
            ("git", *arguments), cwd=directory, capture_output=True, encoding="utf-8", timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return process.stdout.strip()
