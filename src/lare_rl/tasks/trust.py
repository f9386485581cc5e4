"""Decides which modules an environment's name may import. A task file can run code, and a run directory may be untrusted."""

import site
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.tasks.spec import PETTINGZOO_PREFIX, TaskSpec
from lare_rl.util.variables import read_variable

__all__ = ["TRUST_VARIABLE", "check_trusted", "untrusted_module"]

TRUST_VARIABLE = "LARE_TRUST"
"""The environment variable with the modules, separated by commas, that run directories and other files may import."""


def untrusted_module(task: TaskSpec) -> str | None:
    """Return the module that a task's environment would import.

    Return None without such a module, and for a module that this process has imported or that the user trusts.
    """
    module, colon, _ = task.environment.removeprefix(PETTINGZOO_PREFIX).partition(":")
    trusted = [name.strip() for name in read_variable(TRUST_VARIABLE).split(",")]
    return module if colon and module not in sys.modules and module not in trusted else None


def check_trusted(task: TaskSpec, directory: Path) -> None:
    """Check that a run's environment imports nothing but installed packages and trusted modules.

    Raises:
        LareError: it would import another file.
    """
    module = untrusted_module(task)
    path = None if module is None else _find_package(module)
    if path is not None and not any(path.is_relative_to(folder) for folder in _package_folders()):
        raise LareError(
            f"{directory}: its environment {task.environment!r} would run {path}, which belongs to no installed package. "
            f"If you trust that file, set {TRUST_VARIABLE}={module}."
        )


def _find_package(module: str) -> Path | None:
    """Return the file of a module's outermost package, without running it. Return None for built-in and missing modules."""
    try:
        spec = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin in ("built-in", "frozen"):
        return None
    paths = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
    return Path(paths[0]).resolve() if paths else None


def _package_folders() -> set[Path]:
    """Return the folders in which packages and Python itself are installed."""
    paths = sysconfig.get_paths()
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    return {
        Path(path).resolve()
        for path in (*(paths[name] for name in names), *site.getsitepackages(), site.getusersitepackages())
    }
