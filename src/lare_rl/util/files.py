"""Check paths of new files, and replace files as a whole. If the process is killed, or the disk is full, the old file stays."""

import contextlib
import itertools
import os
import shutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

from lare_rl.errors import LareError

__all__ = [
    "check_new_path", "check_writable", "find_free_path", "make_directory", "new_directory", "remove_partial_files", "replace_npz",
    "report_write_error", "write_atomically", "write_bytes", "write_npz",
]  # fmt: skip

RETRY_S = 0.01, 0.03, 0.1, 0.3, 1.0
"""Pauses between attempts to replace a file (s): Windows refuses while another process reads it."""


@contextlib.contextmanager
def report_write_error(path: Path, hint: str = "") -> Iterator[None]:
    """Raise a `LareError` that names `path`, in place of an `OSError`. `hint` ends its message."""
    try:
        yield
    except OSError as error:
        raise LareError(f"{path} cannot be written: {error.strerror or error}{hint}") from error


def check_new_path(path: Path, option: str = "file", overwrite: bool | None = None) -> None:
    """Raise `LareError` if `path` is unusable. Call this before the work whose result goes there.

    Args:
        path: the file.
        option: the word for it in messages, such as an option of the command line.
        overwrite: whether it may exist. None if the caller has no such option.
    """
    with report_write_error(path):
        if path.is_dir():
            raise LareError(f"{path} is not the name of a file; choose another {option}")
        if path.exists() and not overwrite:
            hint = "" if overwrite is None else ", or replace it with --overwrite"
            raise LareError(f"{path} exists, and is not overwritten; choose another {option}{hint}")
        if not path.parent.is_dir():
            raise LareError(f"{path} cannot be written: there is no directory {path.parent}; choose another {option}")
        check_writable(path)


def check_writable(path: Path) -> None:
    """Raise `LareError` if nothing can be written beside `path`."""
    with report_write_error(path):
        tempfile.TemporaryFile(dir=path.parent).close()  # for root, os.access calls even /proc writable


def find_free_path(directory: Path, name: str, suffix: str = "") -> Path:
    """Return DIRECTORY/NAMESUFFIX or, if that exists, DIRECTORY/NAME-2SUFFIX, and so on."""
    endings = itertools.chain([suffix], (f"-{number}{suffix}" for number in itertools.count(2)))
    paths = (directory / f"{name}{ending}" for ending in endings)
    return next(path for path in paths if not path.exists())


def make_directory(directory: Path) -> None:
    """Make a directory and its parents, if they do not exist. Raises `LareError` if that is not possible."""
    with report_write_error(directory):
        directory.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def new_directory(directory: Path) -> Iterator[Path]:
    """Yield an empty directory, which becomes `directory` at the end. After an error nothing is left.

    Raises `LareError` if it cannot be written.
    """
    new = directory.with_name(f".{directory.name}.{uuid4().hex}.new")
    try:
        with report_write_error(directory):
            new.mkdir(parents=True)
            try:
                yield new
            except LareError as error:
                if isinstance(error.__cause__, OSError):  # its message names a file in `new`, whose path nobody knows
                    raise error.__cause__ from None
                raise
            new.rename(directory)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """Let `write` fill a new file, and move it to `path` when it is complete on the disk.

    Raises `LareError` if the file cannot be written.
    """
    new = path.with_name(f"{path.name}.{uuid4().hex}.new")  # unique: another process may write the same file
    with report_write_error(path, "; an existing file is unchanged"):
        if path.exists() and not path.is_file() and not path.is_dir():
            # A device, such as /dev/null, or a pipe is never replaced.
            with path.open("wb") as file:
                write(file)
            return
        try:
            with new.open("wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            _move(new, path)
        finally:  # an interruption must not leave the new file either
            new.unlink(missing_ok=True)


def remove_partial_files(path: Path) -> None:
    """Remove what killed processes have left of writing `path`, whose name may have wildcards."""
    for partial_file in path.parent.glob(f"{path.name}.*.new"):
        partial_file.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write or replace a file as a whole. Raises `LareError` if it cannot be written."""
    write_atomically(path, lambda file: file.write(content))


def replace_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Replace an .npz file. Raises `LareError` if it cannot be written."""
    write_atomically(path, lambda file: write_npz(file, arrays))


def write_npz(file: IO[bytes], arrays: Mapping[str, Any]) -> None:
    """Write arrays of any name. `numpy.savez` refuses the names of its own arguments, such as `file`."""
    import numpy as np  # here, because the command line imports this module before it shows a message

    with zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        for key, array in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)


def _move(new: Path, path: Path) -> None:
    for pause_s in RETRY_S:
        with contextlib.suppress(PermissionError):
            new.replace(path)
            return
        time.sleep(pause_s)
    new.replace(path)
