"""Decides which modules an environment's name may import. A task file can run code, and a run directory may be untrusted."""

import os
import site
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.tasks.spec import PETTINGZOO, TaskSpec

TRUSTED = "LARE_TRUST"
"""The environment variable with the modules, separated by commas, that run directories and other files may import."""


def module_of(task: TaskSpec) -> str | None:
    """The module that is imported to make the task's environment, if its name contains one."""
    module, colon, _ = task.environment.removeprefix(PETTINGZOO).partition(":")
    return module if colon else None


def is_trusted(module: str) -> bool:
    """Whether this process has already imported the module, or the user has named it in `LARE_TRUST`."""
    return module in sys.modules or module in [name.strip() for name in os.environ.get(TRUSTED, "").split(",")]


def check_trusted(task: TaskSpec, directory: Path) -> None:
    """Raise `LareError` if a run's environment would import a file that belongs to no installed package and is not trusted."""
    module = module_of(task)
    if module is None or is_trusted(module):
        return
    place = place_of(module)
    if place is not None and not any(place.is_relative_to(installed) for installed in installed_places()):
        raise LareError(
            f"{directory}: its environment {task.environment!r} would run {place}, which belongs to no installed package; "
            f"if you trust that file, set {TRUSTED}={module}"
        )


def place_of(module: str) -> Path | None:
    """The file of a module's outermost package, found without running it; None if there is none, or if it is built in."""
    try:
        found = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return None
    if found is None or found.origin in ("built-in", "frozen"):
        return None
    places = [found.origin] if found.origin else list(found.submodule_search_locations or ())
    return Path(places[0]).resolve() if places else None


def installed_places() -> set[Path]:
    """The folders in which packages and Python itself are installed."""
    paths = sysconfig.get_paths()
    known = [*(paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")), *site.getsitepackages()]
    return {Path(place).resolve() for place in (*known, site.getusersitepackages())}


def unknown_module(task: TaskSpec) -> str | None:
    """The module that a task's environment would import, unless this process has imported it, or the user trusts it."""
    module = module_of(task)
    return None if module is None or is_trusted(module) else module
