"""Files that are replaced as a whole: if the process is killed, or the disk is full, the old file stays."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

from lare_rl.errors import LareError


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """Like `replace`, but a failure raises a `LareError` of one line."""
    try:
        replace(path, write)
    except OSError as error:
        raise LareError(
            f"{path} cannot be written ({error.strerror or error}); an existing file is unchanged"
        ) from error


def replace(path: Path, write: Callable[[Any], object]) -> None:
    """Let `write` fill a new file, and move it to `path` when it is complete on the disk. Raises `OSError`."""
    new = path.with_name(f"{path.name}.{uuid4().hex}.new")  # unique: another process may write the same file
    try:
        with new.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except BaseException:  # nothing else would remove it
        new.unlink(missing_ok=True)
        raise
