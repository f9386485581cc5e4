"""Decides which modules an environment's name may import. A task file can run code, and a run directory may be untrusted."""

import shlex
import site
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.tasks.spec import PETTINGZOO_PREFIX, TaskSpec, split_environment
from lare_rl.util.variables import read_variable

__all__ = [
    "TRUST_VARIABLE",
    "check_trusted",
    "command_line",
    "trust_environment",
    "trusted_modules",
    "untrusted_module",
]

TRUST_VARIABLE = "LARE_TRUST"
"""The environment variable with the modules, separated by commas, that run directories and other files may import."""

_PETTINGZOO_PACKAGES = ("mpe2", "pettingzoo")
"""Packages whose functions `parallel_env` make environments, and do nothing else."""

_own_environments = set[str]()
"""The names of environments that the user, not only a file, has given to this process."""


def trust_environment(task: TaskSpec) -> None:
    """Trust the environment of a task that the user has given to this process, in all files that it reads later."""
    _own_environments.update(_environments(task))


def _environments(task: TaskSpec) -> set[str]:
    return {task.environment, task.evaluation_task.environment}


def trusted_modules() -> list[str]:
    """Return the modules that the user trusts."""
    return [name for name in map(str.strip, read_variable(TRUST_VARIABLE).split(",")) if name]


def _module_to_trust(task: TaskSpec) -> str | None:
    """Return the module of a task's environment if `LARE_TRUST` must name it before a new process imports it for a report."""
    module, _ = split_environment(task.environment)
    return module if module and module not in trusted_modules() else None


def command_line(task: TaskSpec, *arguments: object) -> str:
    """Return a `lare-rl` command for a run of a task. It sets `LARE_TRUST` if it must import the module of the environment."""
    module = _module_to_trust(task)
    prefix = f"{TRUST_VARIABLE}={module} " if module else ""
    return prefix + shlex.join(["lare-rl", *map(str, arguments)])


def untrusted_module(task: TaskSpec) -> str | None:
    """Return the module of a task's environment, if a report must not import it, else None.

    That is a module that the user does not trust, of a task that the user has not given to this process. A module that the process
    has imported already may be used, but no unknown function of it.
    """
    module = _module_to_trust(task)
    environments = _environments(task)
    if module is None or environments <= _own_environments:
        return None
    return None if module in sys.modules and not any(map(_calls_unknown_function, environments)) else module


def _calls_unknown_function(environment: str) -> bool:
    """Return whether an environment is PettingZoo's, and made by a function that may also do something else."""
    module, function = split_environment(environment)
    is_known = module.partition(".")[0] in _PETTINGZOO_PACKAGES and function == "parallel_env"
    return environment.startswith(PETTINGZOO_PREFIX) and not is_known


def check_trusted(task: TaskSpec, directory: Path) -> None:
    """Raise `LareError` unless the user trusts the module of a run's environment, or it is installed and no unknown function is called."""
    module = untrusted_module(task)
    if module is None:
        return
    folders = _package_folders()
    foreign = [path for path in _package_paths(module) if not any(map(path.is_relative_to, folders))]
    if foreign:
        reason = f"run {foreign[0]}, which is in no folder of installed packages"
    elif any(map(_calls_unknown_function, _environments(task))):
        reason = f"call a function of {module}"
    else:
        return
    raise LareError(
        f"{directory}: its environment {task.environment!r} would {reason}. If you trust that, set "
        f"{TRUST_VARIABLE}={module}."
    )


def _package_paths(module: str) -> list[Path]:
    """Return the file of a module's outermost package, or its folders, without running it. Built-in and missing modules have none."""
    try:
        spec = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return []
    if spec is None or spec.origin in ("built-in", "frozen"):
        return []
    paths = [spec.origin] if spec.origin else spec.submodule_search_locations or ()  # a namespace may have several
    return [Path(path).resolve() for path in paths]


def _package_folders() -> set[Path]:
    """Return the folders in which packages are installed. No module of Python itself makes environments."""
    folders = [sysconfig.get_path(name) for name in ("purelib", "platlib")]
    return {Path(path).resolve() for path in (*folders, *site.getsitepackages(), site.getusersitepackages())}
