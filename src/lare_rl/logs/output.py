"""Output that is written completely or not at all: under a temporary name, which is changed at the end."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from lare_rl.errors import LareError

__all__ = ["atomic_output", "check_output"]

LOG_SUFFIXES = frozenset({".npz", ".parquet", ".arrow", ".json"})
"""Files of logs. A directory with other files is never replaced."""


def check_output(out: Path, overwrite: bool) -> None:
    """Raise `LareError` if `out` exists and must not be replaced, or if nothing can be written there."""
    if out.exists() and not overwrite:
        raise LareError(f"{out} exists: choose another path, or replace it with --overwrite (overwrite=True)")
    if out.is_dir():
        foreign = [path.name for path in sorted(out.iterdir()) if path.is_dir() or path.suffix not in LOG_SUFFIXES]
        if foreign:
            raise LareError(f"{out} cannot be replaced, because {foreign[0]} in it is not a log: choose another path")
    if not out.name or not out.parent.is_dir():
        raise LareError(f"{out} cannot be written: there is no directory {out.parent}")


@contextlib.contextmanager
def atomic_output(out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a temporary path for a file or a directory. At the end it replaces `out`; after an error it is removed.

    Raises:
        LareError: `out` exists, or cannot be written.
    """
    check_output(out, overwrite)
    new, old = (out.with_name(f".{out.name}.{uuid4().hex}.{kind}") for kind in ("new", "old"))
    try:
        yield new
        check_output(out, overwrite)
        if out.exists():
            out.rename(old)
        new.rename(out)
    except OSError as error:
        raise LareError(f"{out} cannot be written ({error.strerror or error}); existing data are unchanged") from error
    finally:
        if old.exists() and not out.exists():
            old.rename(out)
        for path in (new, old):
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
