"""config.json of a run: every setting, the task, the versions, and the hashes of the latent functions."""

import os
import platform
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from lare_rl.config.migrate import CONFIG, FORMAT, migrate
from lare_rl.config.settings import ResolvedSettings
from lare_rl.envs.placement import load_env_spec
from lare_rl.errors import CheckedModel, Count, LareError
from lare_rl.latent.function import LatentFunction
from lare_rl.tasks.spec import TaskSpec
from lare_rl.util.files import write_bytes
from lare_rl.util.processes import n_usable_cores
from lare_rl.util.provenance import code_version
from lare_rl.util.safe_io import read_table

__all__ = ["CONFIG", "Config", "make_config", "read_config", "write_config"]

MAX_CONFIG_BYTES = 8 << 20
VERSIONED_PACKAGES = ("jax", "optax", "gymnasium", "mujoco", "numpy")
"""Packages that results depend on."""


class Config(CheckedModel):
    """The contents of config.json."""

    format: int
    lare: str
    """Version of the package, and the commit in a checkout."""
    settings: ResolvedSettings
    task: TaskSpec
    task_sha256: str
    longest_episode: Count
    """The environment's time limit."""
    function_sha256: tuple[str, ...]
    """Hashes of the latent functions: one for each team, empty for a method without phi."""
    versions: dict[str, str]
    machine: str
    ended_at: tuple[int, ...] = ()
    """The number of steps that was planned before each extension (`extend_run`). The run may have stopped earlier."""


def make_config(task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction]) -> Config:
    """Return the configuration of a new run."""
    return Config(
        format=FORMAT,
        lare=code_version(),
        settings=settings,
        task=task,
        task_sha256=task.digest,
        longest_episode=load_env_spec(task).max_steps,
        function_sha256=tuple(function.digest for function in functions),
        versions=_find_versions(),
        machine=f"{platform.system()} {platform.machine()}, {_describe_cores()}, {jax.default_backend()}",
    )


def _find_versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in VERSIONED_PACKAGES:
        with suppress(PackageNotFoundError):  # an extra that is not installed
            versions[name] = version(name)
    return versions


def _describe_cores() -> str:
    # XLA divides sums among the cores that the process may use, which affects their rounding.
    n_cores = os.cpu_count() or 1
    n_usable = n_usable_cores()
    return f"{n_usable} of {n_cores} cores" if n_usable < n_cores else f"{n_cores} cores"


def write_config(directory: Path, config: Config) -> None:
    """Write config.json. Raises `LareError` if it cannot be written."""
    write_bytes(directory / CONFIG, f"{config.model_dump_json(indent=1)}\n".encode())


def read_config(directory: Path) -> Config:
    """Read config.json, of this or an earlier version.

    Raises `LareError` if the directory is not a run, or its configuration is not valid.
    """
    path = directory / CONFIG
    if not os.path.isfile(path):  # False also for a name that is too long, where Path.is_file raises an error
        raise LareError(f"{directory} is not a run: there is no {CONFIG} in it")
    values = read_table(path, MAX_CONFIG_BYTES)
    try:
        return Config(**migrate(values))
    except (LareError, ValueError, TypeError) as error:
        raise LareError(f"{path}: {error}") from error
