"""Compiled programs that outlive a process: JAX's persistent compilation cache, in the user's cache directory.

A run compiles for half a minute before its first step. The next process that needs the same programs reads them.

The environment variable LARE_CACHE names another directory, or is `off`. If the user has chosen a cache for JAX, by
JAX_COMPILATION_CACHE_DIR or in a program, JAX uses that one and this module does nothing.
"""

import hashlib
import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path

from filelock import FileLock
from platformdirs import user_cache_path

__all__ = ["cache_variables", "enable_cache"]

_LOCK_TIMEOUT_S = 5

_PROGRAM_SUFFIX, _TIME_SUFFIX = "-cache", "-atime"
"""JAX writes two files for a program, in this order. Their names end with these suffixes."""


def cache_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """Prepare the cache, and return the environment variables that turn it on in processes that have not imported JAX yet.

    The result is empty if the user has turned the cache off or has chosen one for JAX, or if no cache can be written.
    """
    if "JAX_COMPILATION_CACHE_DIR" in variables:
        return {}
    settings = {name.upper(): str(value) for name, value in _prepare_cache(variables).items()}
    return {name: value for name, value in settings.items() if name not in variables}


def enable_cache() -> None:
    """Turn on the cache in a process that has already imported JAX."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    if jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore[reportAttributeAccessIssue] - JAX makes it at run time
        return
    for name, value in _prepare_cache(os.environ).items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # JAX asks once whether there is a cache, at its first compilation


def _prepare_cache(variables: Mapping[str, str]) -> dict[str, str | float]:
    """Create or repair the cache for this kind of processor, and return JAX's settings for it.

    They are empty if no cache can be used. JAX's environment variables have the names of the settings in capitals.
    """
    setting = variables.get("LARE_CACHE", "").strip()
    if setting.lower() == "off":
        return {}
    try:
        root = Path(setting).expanduser() if setting else user_cache_path("lare")
        directory = root / f"compiled-{_processor_hash()}"
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        _remove_incomplete_programs(directory)
    except (OSError, RuntimeError):  # there may be no home directory
        return {}
    if not os.access(directory, os.W_OK):
        return {}
    return {
        "jax_compilation_cache_dir": str(directory),
        # In bytes. JAX removes the programs that were not read for the longest time.
        "jax_compilation_cache_max_size": 2**30,
        # Programs that compile faster are not saved.
        "jax_persistent_cache_min_compile_time_secs": 0.1,
    }


def _remove_incomplete_programs(directory: Path) -> None:
    """Remove programs with one file instead of two. A killed process leaves them, and JAX fails when it reads them."""
    with FileLock(directory / ".lockfile", timeout=_LOCK_TIMEOUT_S):  # JAX's own lock, so that no process is writing
        programs, times = (
            {file.name.removesuffix(suffix) for file in directory.glob(f"*{suffix}")}
            for suffix in (_PROGRAM_SUFFIX, _TIME_SUFFIX)
        )
        for name in programs ^ times:
            for suffix in (_PROGRAM_SUFFIX, _TIME_SUFFIX):
                (directory / f"{name}{suffix}").unlink(missing_ok=True)


def _processor_hash() -> str:
    """Hash this processor's features. Compiled programs fit one kind of processor, and several kinds may share a home directory."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        features = sorted(set(re.findall(r"^(?:flags|Features)\s*:\s*(.*)$", text, re.MULTILINE)))
    except OSError:
        features = [platform.processor()]
    return hashlib.sha256("\n".join([platform.machine(), *features]).encode()).hexdigest()[:12]
