"""Compiled programs that outlive a process: JAX's persistent compilation cache, in the user's cache directory.

A run compiles for half a minute before its first step. The next process that needs the same programs reads them.

The environment variable LARE_CACHE names another directory, or is `off`. If the user has given JAX a cache, by
JAX_COMPILATION_CACHE_DIR or in a program, JAX uses that one and this module does nothing.
"""

import hashlib
import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path

from filelock import FileLock, Timeout
from platformdirs import user_cache_path

SETTING, OFF = "LARE_CACHE", "off"

LARGEST = 2**30
"""The largest size of the cache in bytes. JAX removes the least recently read programs."""

SHORTEST = 0.1
"""Seconds. Programs that compile faster are not kept."""

OF_JAX = "JAX_COMPILATION_CACHE_DIR"

PROGRAM, TIME = "-cache", "-atime"
"""How JAX ends the names of the two files that it writes for a program, in this order."""


def variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables that make JAX keep programs, for a process that has not imported JAX yet, and for its children.

    Empty if the user said `off` or has chosen a cache for JAX, or if no cache can be written.
    """
    if OF_JAX in environment or (directory := prepared(environment)) is None:
        return {}
    return {
        OF_JAX: str(directory),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(LARGEST),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(SHORTEST),
    }


def keep() -> None:
    """Make JAX keep programs from now on, in a process that has already imported it."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    chosen = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue] - JAX makes it at run time
    if chosen is not None or (directory := prepared(os.environ)) is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
    compilation_cache.reset_cache()  # JAX asks once whether there is a cache, at its first compilation


def prepared(environment: Mapping[str, str]) -> Path | None:
    """The cache directory for this kind of processor, created and repaired; None if it is off or cannot be written."""
    said = environment.get(SETTING, "")
    if said == OFF:
        return None
    directory = (Path(said) if said else user_cache_path("lare")) / f"compiled-{processor()}"
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        mend(directory)
    except (OSError, Timeout):
        return None
    return directory if os.access(directory, os.W_OK) else None


def mend(directory: Path) -> None:
    """Remove files that a killed process has left incomplete; JAX would fail to read them every time."""
    with FileLock(directory / ".lockfile", timeout=5):  # JAX's own lock, so that no process is writing
        programs, times = (
            {file.name.removesuffix(ending) for file in directory.glob(f"*{ending}")} for ending in (PROGRAM, TIME)
        )
        for name in programs ^ times:
            for ending in (PROGRAM, TIME):
                (directory / f"{name}{ending}").unlink(missing_ok=True)


def processor() -> str:
    """A hash of this processor's features. Compiled programs fit one kind of processor, and several may share a home directory."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        able = sorted(set(re.findall(r"^(?:flags|Features)\s*:\s*(.*)$", text, re.MULTILINE)))
    except OSError:
        able = [platform.processor()]
    return hashlib.sha256("\n".join([platform.machine(), *able]).encode()).hexdigest()[:12]
