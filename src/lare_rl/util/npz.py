"""Reading of .npz files that may be damaged, or come from another person. `files.py` writes them."""

import contextlib
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lare_rl.errors import LareError
from lare_rl.util.sanitize import one_line

__all__ = ["DAMAGED_FILE_ERRORS", "open_npz", "report_damage"]

DAMAGED_FILE_ERRORS = (
    *(OSError, ValueError, KeyError, EOFError, NotImplementedError, RecursionError, zipfile.BadZipFile, zlib.error),
    *(tokenize.TokenError, TypeError, IndexError, AttributeError, OverflowError, MemoryError, SyntaxError),
)
"""Errors from reading a file that is damaged, or holds something else."""

MAX_REASON = 200
"""Letters that are quoted of an error's message, because some messages repeat the file."""
_ENCRYPTED = 1  # a flag of an entry


@contextlib.contextmanager
def open_npz(path: Path, max_bytes: int | None = None) -> Iterator[np.lib.npyio.NpzFile]:
    """Open the arrays of a file, and close it at the end, even if it is damaged.

    Compressed arrays are only read with `max_bytes`, the largest size of all arrays in memory.

    Raises `ValueError` if arrays are compressed or too large, or another of the `DAMAGED_FILE_ERRORS`.
    """
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            raise ValueError("it is no .npz file, or not whole")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            entries = arrays.zip.infolist()
            for entry in entries:
                # A few compressed bytes can unpack to gigabytes.
                is_compressed = max_bytes is None and entry.compress_type != zipfile.ZIP_STORED
                if is_compressed or entry.flag_bits & _ENCRYPTED:
                    raise ValueError(f"{entry.filename} is compressed or encrypted, and LaRe writes no such arrays")
            if max_bytes is not None and sum(entry.file_size for entry in entries) > max_bytes:
                raise ValueError(f"its arrays have more than {max_bytes / 2**30:.3g} GiB")
            yield arrays


@contextlib.contextmanager
def report_damage(problem: str) -> Iterator[None]:
    """Raise a `LareError` that begins with `problem`, in place of the errors that a damaged file causes."""
    try:
        yield
    except DAMAGED_FILE_ERRORS as error:
        reason = one_line(f"{type(error).__name__}: {error}")
        raise LareError(f"{problem}: {reason[:MAX_REASON]}") from error
