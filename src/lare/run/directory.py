"""The run directory: what a run leaves on the disk, and reading it again.

config.json          every setting, versions and commit, the spec's and the function's hash
latent_function.py   phi, and .json: replies, checks; where teams learn, latent_function_TEAM.py; latent_function-STEP.py is one
                     that took its place at that step
metrics.jsonl        one JSON object a line, for each seed and evaluation
checkpoint/          see checkpoint.py
failed_batch.npz     what the latent function was given, if it failed
"""

import contextlib
import json
import os
import platform
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from uuid import uuid4

import jax
import numpy as np
from jaxtyping import Float

from lare.errors import Checked, LareError, shortened
from lare.files import write_atomically
from lare.foreign import read_json, read_text
from lare.latent.function import LatentFunction, LatentRewardError, load, per_role, read_source
from lare.run.checkpoint import STATE, saved_host
from lare.run.formats import FORMAT, migrated
from lare.run.settings import ResolvedSettings
from lare.source import source
from lare.tasks.spec import Judges, TaskSpec
from lare.tasks.table import env_spec
from lare.tasks.trust import check_trusted

CONFIG, METRICS, FUNCTION, CHECKPOINT = "config.json", "metrics.jsonl", "latent_function.py", "checkpoint"
FAILED_BATCH = "failed_batch.npz"

VERSIONS = ("jax", "optax", "gymnasium", "mujoco", "numpy")
"""Packages that results depend on."""


LARGEST_CONFIG, LARGEST_METRICS = 8 << 20, 512 << 20
"""Bytes of these files."""

LARGEST_STEP = 2**53
"""Of the whole numbers in metrics.jsonl; beyond it a float is another number."""


class Config(Checked):
    """config.json."""

    format: int
    lare: str
    """Version of the package, and the commit in a checkout."""
    settings: ResolvedSettings
    task: TaskSpec
    task_sha256: str
    longest_episode: int
    """The environment's time limit."""
    function_sha256: tuple[str, ...]
    """Of the latent functions in use: one for each team, none for a method that needs none."""
    isolation: str | None
    """What stands around the latent function while training."""
    versions: dict[str, str]
    machine: str
    ended_at: tuple[int, ...] = ()
    """The steps that it was to make before it was extended, each time that it was."""


def describe(task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction]) -> Config:
    """Everything that the run depends on."""
    return Config(
        format=FORMAT,
        lare=source(),
        settings=settings,
        task=task,
        task_sha256=task.digest,
        longest_episode=env_spec(task).max_steps,
        function_sha256=tuple(function.digest for function in functions),
        isolation=isolation(task, functions[0]) if functions else None,
        versions={name: version(name) for name in VERSIONS} | {"python": platform.python_version()},
        machine=f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}",
    )


def isolation(task: TaskSpec, function: LatentFunction) -> str:
    """What stands around a task's latent functions on this machine."""
    return function.evaluator(task.observation_size, task.action_size).isolation


def function_file(task: TaskSpec, role: TaskSpec, since: int = 0) -> str:
    """Where the latent function of a role is kept that is in use since some step."""
    of_role = "" if role is task else f"_{role.team}"
    return f"latent_function{of_role}-{since}.py" if since else f"latent_function{of_role}.py"


class Busy(LareError):
    """Another process is training in the run's directory."""


@dataclass(frozen=True)
class Run:
    """A run on the disk."""

    directory: Path
    config: Config
    functions: tuple[LatentFunction, ...]
    """One for each role of the task; none for a method that needs none."""
    since: int = 0
    """The step from which they have been in use."""

    @property
    def function(self) -> LatentFunction | None:
        """The only one, or the first."""
        return self.functions[0] if self.functions else None

    @property
    def checkpoint(self) -> Path:
        return self.directory / CHECKPOINT

    @property
    def seeds(self) -> list[int]:
        return self.config.settings.all_seeds

    @property
    def judges(self) -> Judges:
        """Which observation the factors judge a step by."""
        return self.config.settings.judged_by(self.config.task)

    def place_of(self, seed: int | None) -> int:
        """The place of a seed among those of the run; of None, the first. Raises `LareError` where there is no such seed."""
        if seed is None:
            return 0
        if seed not in self.seeds:
            raise LareError(f"{self.directory} has no seed {seed}; its seeds: {', '.join(map(str, self.seeds))}")
        return self.seeds.index(seed)

    def has_checkpoint(self) -> bool:
        """Whether it came as far as its first checkpoint."""
        return (self.checkpoint / STATE).exists()

    def metrics(self) -> list[dict[str, Any]]:
        """Every complete line of metrics.jsonl, in order."""
        return read_metrics(self.directory)

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

    def factors(
        self, function: LatentFunction, before: np.ndarray, action: np.ndarray, after: np.ndarray
    ) -> Float[np.ndarray, "batch factors"]:
        """The factors z of some steps, by the observations that are judged.

        Raises:
            LareError: the function failed; what it was given is kept in the run directory.
        """
        try:
            return function.of_steps(before, action, after, self.judges)
        except LatentRewardError as error:
            place = self.keep_batch(error.observation, error.action)
            raise LareError(f"{error}; it was given the batch in {place}; the last checkpoint is whole") from error

    def keep_functions(self) -> None:
        """Write the functions that are in use, each to its file. Raises `LareError` where they cannot be written."""
        for function, role in per_role(self.functions, self.config.task):
            function.save(self.directory / function_file(self.config.task, role, self.since))

    def keep_batch(self, observation: np.ndarray, action: np.ndarray) -> Path:
        """Put the batch that a latent function failed with beside the run, to be looked at."""
        path = self.directory / FAILED_BATCH
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, observation=observation, action=action))
        return path

    def extended(self, steps: int) -> "Run":
        """The run with more steps to make; config.json says so from now on.

        Raises:
            LareError: they are not more, or no whole number of iterations.
        """
        config = self.config
        if steps < config.settings.steps:
            raise LareError(
                f"steps = {steps}: the run makes {config.settings.steps} anyway, and it can only be made longer"
            )
        if steps == config.settings.steps:
            return self
        settings = ResolvedSettings(**{**dict(config.settings), "steps": steps})
        longer = config.model_copy(update={"settings": settings, "ended_at": (*config.ended_at, config.settings.steps)})
        text = longer.model_dump_json(indent=1) + "\n"
        write_atomically(self.directory / CONFIG, lambda file: file.write(text.encode()))
        return replace(self, config=longer)

    def truncate(self, length: int) -> None:
        """Take back the lines that were written after a checkpoint; they come again.

        Raises:
            LareError: lines from before it are missing.
        """
        path = self.directory / METRICS
        size = path.stat().st_size if path.exists() else 0
        if size < length:
            raise LareError(
                f"{path} has {size} bytes, and the checkpoint comes after {length}: was the run copied while it was training?"
            )
        if size > length:
            os.truncate(path, length)


def create(directory: Path, task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction]) -> Run:
    """A new run directory. Raises `LareError` where there is something of that name."""
    config = describe(task, settings, functions)
    taken = LareError(
        f"{directory} exists, and a run never overwrites another: choose another --out, or go on with --resume"
    )
    if directory.exists() or directory.is_symlink():
        raise taken
    new = directory.with_name(f".{directory.name}.{uuid4().hex}.new")  # renamed when it is whole
    try:
        new.mkdir(parents=True)
        for function, role in per_role(functions, task) if functions else ():
            function.save(new / function_file(task, role))
        text = config.model_dump_json(indent=1) + "\n"
        write_atomically(new / CONFIG, lambda file: file.write(text.encode()))
        new.rename(directory)
    except OSError as error:
        if directory.exists():  # since a moment ago
            raise taken from None
        raise LareError(f"the run directory {directory} cannot be made: {error.strerror}") from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return Run(directory, config, tuple(functions))


def default_directory(task: TaskSpec, settings: ResolvedSettings) -> Path:
    """runs/TASK-METHOD-ALGORITHM-sSEED, with a number behind it as long as that is taken."""
    name = f"{task.name}-{settings.method}-{settings.algorithm}-s{settings.seed}"
    number = 1
    while (directory := Path("runs") / (name if number == 1 else f"{name}-{number}")).exists():
        number += 1
    return directory


def read_config(directory: Path) -> Config:
    """What a run depends on. Raises `LareError` where there is no run, or no sense in it."""
    path = directory / CONFIG
    if not path.is_file():
        raise LareError(f"{directory} is not a run: there is no {CONFIG} in it")
    try:
        values = read_json(read_text(path, LARGEST_CONFIG))
        if not isinstance(values, dict):
            raise LareError("it is JSON, but not an object")
        return Config(**migrated(values))
    except (LareError, OSError, ValueError, TypeError) as error:
        raise LareError(f"{path}: {error}") from error


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """Every complete line of a run's metrics.jsonl, in order. Raises `LareError` where one makes no sense, or none can be read."""
    path = directory / METRICS
    found = []
    for place, line in enumerate(whole_lines(path), start=1):
        try:
            found.append(read_json(line))
        except ValueError as error:
            raise LareError(f"{path} is damaged: {error} in line {place}") from error
        if not is_evaluation(found[-1]):
            raise LareError(f"{path} is damaged: line {place} is no evaluation")
    return found


def whole_lines(path: Path) -> list[str]:
    """Lines that have their end; none where there is no such file."""
    return read_text(path, LARGEST_METRICS).split("\n")[:-1] if path.exists() else []


def is_evaluation(line: Any) -> bool:
    """Whether it is a line of metrics.jsonl: numbers by name, and what they were measured of."""
    return (
        isinstance(line, dict)
        and all(type(line.get(name)) is int and 0 <= line[name] <= LARGEST_STEP for name in ("step", "seed"))
        and all(value is None or type(value) in (int, float) for value in line.values())
        and all(abs(value) <= LARGEST_STEP for value in line.values() if type(value) is int)
    )


def read_measured(directory: Path) -> Run:
    """A run of which only what it measured is wanted: its functions are left alone. Raises `LareError` as `read_config`."""
    return Run(directory, read_config(directory), ())


def open_run(directory: str | Path) -> Run:
    """Read a run directory; its latent function is verified again before anything executes it.

    Raises:
        LareError: it is not a run, its files are not what they should be, or its environment is a file that nobody named.
    """
    directory = Path(directory)
    config = read_config(directory)
    check_trusted(config.task, directory)
    functions, since, digests = [], 0, config.function_sha256
    if config.settings.reflect_every is not None and (host := saved_host(directory / CHECKPOINT)) is not None:
        since, digests = host.get("functions_since", 0), tuple(host.get("function_sha256", ()))
    if digests and len(digests) != len(config.task.roles):
        raise LareError(f"{directory}: there are {len(digests)} latent functions for {len(config.task.roles)} roles")
    for role, digest in zip(config.task.roles, digests, strict=True) if digests else ():
        place = directory / function_file(config.task, role, since)
        if read_source(place).digest != digest:
            raise LareError(f"{place} is not the function that this run was trained with: its hash changed")
        functions.append(load(place, role))
    return Run(directory, config, tuple(functions), since)


def as_run(given: Run | str | Path) -> Run:
    """A run by itself, or by its directory. Raises `LareError` as `open_run`, and where it is neither."""
    if isinstance(given, Run):
        return given
    if isinstance(given, (str, Path)):
        return open_run(given)
    raise LareError(f"a run is its directory, or what lare.train and lare.open_run give; it is {shortened(given)}")


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
        except BlockingIOError:
            raise Busy(f"another process is training in {run.directory}") from None
        except OSError:  # some network file systems lock nothing
            pass
        yield
