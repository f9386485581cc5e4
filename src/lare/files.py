"""Files that are replaced as a whole: whoever is killed in between, or finds the disk full, leaves what was there."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

from lare.errors import LareError


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """`replace`, but that what goes wrong is a `LareError` of one line."""
    try:
        replace(path, write)
    except OSError as error:
        raise LareError(f"{path} cannot be written ({error.strerror or error}); what was there is as it was") from error


def replace(path: Path, write: Callable[[Any], object]) -> None:
    """Let `write` fill a new file, and put it in the place of `path` only when it is safe on the disk. Raises `OSError`."""
    new = path.with_name(f"{path.name}.{uuid4().hex}.new")  # of its own: another process may be writing the same file
    try:
        with new.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except BaseException:  # nobody else would know its name
        new.unlink(missing_ok=True)
        raise
