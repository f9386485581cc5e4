"""The run directory: what a run leaves on the disk, and reading it again.

config.json          every setting, the package version, the spec's and the function's hash
latent_function.py   the phi in use, and .json: replies, checks
metrics.jsonl        one JSON object a line, for each seed and evaluation
checkpoint/          see checkpoint.py
failed_batch.npz     what the latent function was given, if it failed
"""

import contextlib
import json
import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import lare
from lare.errors import Checked, LareError
from lare.latent.function import LatentFunction, load
from lare.tasks.spec import Judges, TaskSpec, time_limit
from lare.training.checkpoint import STATE, write_atomically
from lare.training.settings import Settings

CONFIG, METRICS, FUNCTION, CHECKPOINT = "config.json", "metrics.jsonl", "latent_function.py", "checkpoint"
FAILED_BATCH = "failed_batch.npz"

VERSIONS = ("jax", "optax", "gymnasium", "mujoco", "numpy")
"""Packages that figures depend on."""


class Config(Checked):
    """config.json."""

    lare: str
    """Version of the package."""
    settings: Settings
    task: TaskSpec
    task_sha256: str
    longest_episode: int
    """The environment's time limit."""
    function_sha256: str | None
    isolation: str | None
    """What stands around the latent function while training."""
    versions: dict[str, str]
    machine: str


def describe(task: TaskSpec, settings: Settings, function: LatentFunction | None) -> Config:
    """Everything that the run depends on. Raises `LareError` where the replay could not hold a single episode."""
    longest = time_limit(task)
    if settings.rows < longest + 2:
        raise LareError(f"capacity = {settings.rows} is too small: an episode of {task.name} takes up to {longest + 1}")
    return Config(
        lare=lare.__version__,
        settings=settings,
        task=task,
        task_sha256=task.digest,
        longest_episode=longest,
        function_sha256=function.digest if function else None,
        isolation=isolation(task, function) if function else None,
        versions={name: version(name) for name in VERSIONS} | {"python": platform.python_version()},
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}",
    )


def isolation(task: TaskSpec, function: LatentFunction) -> str:
    """What stands around a task's latent function on this machine."""
    return function.evaluator(task.observation_size, task.action_size).isolation


@dataclass(frozen=True)
class Run:
    """A run on the disk."""

    directory: Path
    config: Config
    function: LatentFunction | None

    @property
    def checkpoint(self) -> Path:
        return self.directory / CHECKPOINT

    @property
    def seeds(self) -> list[int]:
        return self.config.settings.all_seeds

    @property
    def judges(self) -> Judges:
        """Which observation the factors judge a step by."""
        return self.config.settings.judges or self.config.task.judges

    def has_checkpoint(self) -> bool:
        """Whether it came as far as its first checkpoint."""
        return (self.checkpoint / STATE).exists()

    def metrics(self) -> list[dict[str, Any]]:
        """Every complete line of metrics.jsonl, in order."""
        path = self.directory / METRICS
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
        return [json.loads(line) for line in lines if line.endswith("\n")]

    def append(self, lines: Sequence[dict[str, Any]]) -> int:
        """Add lines to metrics.jsonl; returns how long the file is then."""
        path = self.directory / METRICS
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write("".join(json.dumps(line) + "\n" for line in lines))
                file.flush()
                os.fsync(file.fileno())
                return file.tell()
        except OSError as error:
            raise LareError(
                f"{path} cannot be written: {error.strerror or error}; the last checkpoint is whole"
            ) from error

    def keep_batch(self, observation: np.ndarray, action: np.ndarray) -> Path:
        """Put the batch that a latent function failed with beside the run, to be looked at."""
        path = self.directory / FAILED_BATCH
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, observation=observation, action=action))
        return path

    def truncate(self, length: int) -> None:
        """Take back the lines that were written after a checkpoint; they come again."""
        path = self.directory / METRICS
        if path.exists():
            with path.open("r+b") as file:
                file.truncate(length)


def create(directory: Path, task: TaskSpec, settings: Settings, function: LatentFunction | None) -> Run:
    """A new run directory. Raises `LareError` where there is something of that name."""
    config = describe(task, settings, function)
    try:
        directory.mkdir(parents=True)
    except FileExistsError:
        raise LareError(
            f"{directory} exists, and a run never overwrites another: choose another --out, or go on with --resume"
        ) from None
    except OSError as error:
        raise LareError(f"the run directory {directory} cannot be made: {error.strerror}") from error
    try:
        if function is not None:
            function.save(directory / FUNCTION)
        # Last, and whole or not at all: what has a config.json is a run.
        text = config.model_dump_json(indent=1) + "\n"
        write_atomically(directory / CONFIG, lambda file: file.write(text.encode()))
    except OSError as error:
        raise LareError(f"{directory} cannot be written: {error.strerror}") from error
    return Run(directory, config, function)


def default_directory(task: TaskSpec, settings: Settings) -> Path:
    """runs/TASK-METHOD-ALGORITHM-sSEED, with a number behind it as long as that is taken."""
    name = f"{task.name}-{settings.method}-{settings.algorithm}-s{settings.seed}"
    number = 1
    while (directory := Path("runs") / (name if number == 1 else f"{name}-{number}")).exists():
        number += 1
    return directory


def open_run(directory: str | Path) -> Run:
    """Read a run directory; its latent function is verified again before anything executes it.

    Raises:
        LareError: it is not a run, or its files are not what they should be.
    """
    directory = Path(directory)
    path = directory / CONFIG
    if not path.is_file():
        raise LareError(f"{directory} is not a run: there is no {CONFIG} in it")
    try:
        config = Config(**json.loads(path.read_text(encoding="utf-8")))
    except (LareError, OSError, ValueError, TypeError) as error:
        raise LareError(f"{path}: {error}") from error
    function = load(directory / FUNCTION, config.task) if config.function_sha256 else None
    if function is not None and function.digest != config.function_sha256:
        raise LareError(f"{directory / FUNCTION} is not the function that this run was trained with: its hash changed")
    return Run(directory, config, function)


@contextlib.contextmanager
def locked(run: Run) -> Iterator[None]:
    """Keep a second process from training in the same directory, where the system has file locks."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with (run.directory / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise LareError(f"another process is training in {run.directory}") from None
        yield
