"""Whose code an environment's name may import: a task file is code, and a run directory may be anybody's."""

import os
import site
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

from lare.errors import LareError
from lare.tasks.spec import PETTINGZOO, TaskSpec

TRUSTED = "LARE_TRUST"
"""The environment variable that names modules, with commas between, that files other than one's own task may import."""


def module_of(task: TaskSpec) -> str | None:
    """The module that making the task's environment imports by the name in the file, if there is one."""
    module, colon, _ = task.environment.removeprefix(PETTINGZOO).partition(":")
    return module if colon else None


def is_trusted(module: str) -> bool:
    """Whether this process has imported it already, or the user has named it."""
    return module in sys.modules or module in [name.strip() for name in os.environ.get(TRUSTED, "").split(",")]


def check_trusted(task: TaskSpec, directory: Path) -> None:
    """Raise `LareError` where a run's environment would import a file that is of no installed package and that nobody named."""
    module = module_of(task)
    if module is None or is_trusted(module):
        return
    place = place_of(module)
    if place is not None and not any(place.is_relative_to(installed) for installed in installed_places()):
        raise LareError(
            f"{directory}: its environment {task.environment!r} would run {place}, which is of no installed package; "
            f"if you trust that file, set {TRUSTED}={module}"
        )


def place_of(module: str) -> Path | None:
    """The file of a module's outermost package, found without running it; None where there is none, or it is built in."""
    try:
        found = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return None
    if found is None or found.origin in ("built-in", "frozen"):
        return None
    places = [found.origin] if found.origin else list(found.submodule_search_locations or ())
    return Path(places[0]).resolve() if places else None


def installed_places() -> set[Path]:
    """Where packages are installed, and Python itself."""
    paths = sysconfig.get_paths()
    known = [*(paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")), *site.getsitepackages()]
    return {Path(place).resolve() for place in (*known, site.getusersitepackages())}
