"""Output that is written whole or not at all: under a temporary name, which is changed at the end."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from lare_rl.errors import LareError

OF_LOGS = frozenset({".npz", ".parquet", ".arrow", ".json"})
"""Files of logs. A directory that holds others is never replaced."""


def check_free(out: Path, overwrite: bool) -> None:
    """Raise `LareError` if `out` exists and must not be overwritten, or if nothing can be written there."""
    if out.exists() and not overwrite:
        raise LareError(f"{out} exists: choose another directory, or replace it with --overwrite (overwrite=True)")
    if out.is_dir():
        other = next((path for path in sorted(out.iterdir()) if path.is_dir() or path.suffix not in OF_LOGS), None)
        if other is not None:
            raise LareError(
                f"{out} holds {other.name}, which is not a log, and is not replaced: choose another directory"
            )
    if not out.name or not out.parent.is_dir():
        raise LareError(f"{out} cannot be written: there is no directory {out.parent}")


@contextlib.contextmanager
def whole(out: Path, overwrite: bool) -> Iterator[Path]:
    """A path beside `out` to write to, a file or a directory. At the end it replaces `out`; after an error it is removed.

    Raises:
        LareError: it cannot be written, or `out` exists.
    """
    check_free(out, overwrite)
    new, old = (out.with_name(f".{out.name}.{uuid4().hex}.{kind}") for kind in ("new", "old"))
    try:
        yield new
        check_free(out, overwrite)
        if out.exists():
            out.rename(old)
        new.rename(out)
    except OSError as error:
        raise LareError(f"{out} cannot be written ({error.strerror or error}); existing data are unchanged") from error
    finally:
        if old.exists() and not out.exists():
            old.rename(out)
        for path in (new, old):
            remove(path)


def remove(path: Path) -> None:
    """Remove a file, or a directory with its contents, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
