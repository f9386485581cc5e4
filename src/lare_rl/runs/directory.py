"""The run directory: the files of a run, and functions that read them.

config.json          every setting, versions and commit, the hashes of the spec and of the function
latent_function.py   phi, with its replies and checks in .json. With several teams, one latent_function_TEAM.py for each.
                     latent_function-STEP.py replaced it at that step
metrics.jsonl        one JSON object in each line, for each seed and evaluation
checkpoint/          see checkpoint.py
failed_batch.npz     the input of the latent function, if it failed
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

from lare_rl.config.migrate import FORMAT, migrated
from lare_rl.config.settings import ResolvedSettings
from lare_rl.envs.families import env_spec
from lare_rl.errors import Checked, LareError, shortened
from lare_rl.latent.factors import LatentRewardError
from lare_rl.latent.function import LatentFunction, per_role
from lare_rl.latent.saved import load, read_source
from lare_rl.runs.checkpoint import STATE, saved_host
from lare_rl.tasks.spec import Judges, TaskSpec
from lare_rl.tasks.trust import check_trusted
from lare_rl.util.files import write_atomically
from lare_rl.util.provenance import source
from lare_rl.util.safe_io import read_json, read_text

CONFIG, METRICS, FUNCTION, CHECKPOINT = "config.json", "metrics.jsonl", "latent_function.py", "checkpoint"
FAILED_BATCH = "failed_batch.npz"

VERSIONS = ("jax", "optax", "gymnasium", "mujoco", "numpy")
"""Packages that results depend on."""


LARGEST_CONFIG, LARGEST_METRICS = 8 << 20, 512 << 20
"""The largest sizes of these files in bytes."""

LARGEST_STEP = 2**53
"""The largest whole number in metrics.jsonl. A larger one may change when it becomes a float."""


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
    """Hashes of the latent functions in use: one for each team; empty for a method that needs none."""
    versions: dict[str, str]
    machine: str
    ended_at: tuple[int, ...] = ()
    """The number of steps of the run before each time that it was extended."""


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
        versions={name: version(name) for name in VERSIONS} | {"python": platform.python_version()},
        machine=f"{platform.system()} {platform.machine()}, {cores()}, {jax.default_backend()}",
    )


def cores() -> str:
    """How many cores this process may use, and how many there are: XLA divides sums among them, which decides about rounding."""
    there = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else there
    return f"{usable} of {there} cores" if usable < there else f"{there} cores"


def function_file(task: TaskSpec, role: TaskSpec, since: int = 0) -> str:
    """The file of the latent function of a role that has been in use since the step `since`."""
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
    """One for each role of the task; empty for a method that needs none."""
    since: int = 0
    """The step from which the functions have been in use."""

    @property
    def function(self) -> LatentFunction | None:
        """The only function, or the first; None if there is none."""
        return self.functions[0] if self.functions else None

    @property
    def checkpoint(self) -> Path:
        return self.directory / CHECKPOINT

    @property
    def seeds(self) -> list[int]:
        return self.config.settings.all_seeds

    @property
    def judges(self) -> Judges:
        """Which observation of a step the factors judge."""
        return self.config.settings.judged_by(self.config.task)

    @property
    def untrained(self) -> str | None:
        """Why the policy has not been updated; None if it has been, or if there is no evaluation yet."""
        settings, lines = self.config.settings, self.metrics()
        if settings.untrained or not lines:
            return settings.untrained
        if any(name.startswith("critic/loss") and line[name] is not None for line in lines for name in line):
            return None
        step = lines[-1]["step"]
        if step <= settings.warmup:
            return f"all {step:,} steps so far were random ({settings.algorithm}.warmup is {settings.warmup:,})"
        return (
            f"the policy has not been updated in {step:,} steps: {settings.algorithm} needs "
            f"{getattr(settings.hyperparameters, 'batch_size', 1)} finished episodes for its first update "
            f"({settings.algorithm}.batch_size)"
        )

    def place_of(self, seed: int | None) -> int:
        """The index of a seed among those of the run; 0 for None. Raises `LareError` if there is no such seed."""
        if seed is None:
            return 0
        if seed not in self.seeds:
            raise LareError(f"{self.directory} has no seed {seed}; its seeds: {', '.join(map(str, self.seeds))}")
        return self.seeds.index(seed)

    def has_checkpoint(self) -> bool:
        """Whether there is a checkpoint."""
        return (self.checkpoint / STATE).exists()

    def metrics(self) -> list[dict[str, Any]]:
        """Every complete line of metrics.jsonl, in order."""
        return read_metrics(self.directory)

    def append(self, lines: Sequence[dict[str, Any]]) -> int:
        """Add lines to metrics.jsonl; returns the new size of the file."""
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
        """The factors z of some steps, from the observations that are judged.

        Raises:
            LareError: the function failed; its input is saved in the run directory.
        """
        try:
            return function.of_steps(before, action, after, self.judges)
        except LatentRewardError as error:
            place = self.keep_batch(error.observation, error.action)
            raise LareError(f"{error}; it was given the batch in {place}; the last checkpoint is whole") from error

    def keep_functions(self) -> None:
        """Write the functions that are in use, each to its file. Raises `LareError` if they cannot be written."""
        for function, role in per_role(self.functions, self.config.task):
            function.save(self.directory / function_file(self.config.task, role, self.since))

    def keep_batch(self, observation: np.ndarray, action: np.ndarray) -> Path:
        """Save the batch on which a latent function failed in the run directory, so that the user can inspect it."""
        path = self.directory / FAILED_BATCH
        write_atomically(path, lambda file: np.savez(file, allow_pickle=False, observation=observation, action=action))
        return path

    def extended(self, steps: int) -> "Run":
        """The run with a larger number of steps, which is written to config.json.

        Raises:
            LareError: the number is smaller than before, or not a multiple of an iteration's steps.
        """
        config = self.config
        if steps < config.settings.steps:
            raise LareError(
                f"steps = {steps}: the run is planned for {config.settings.steps}, and this number can only be increased"
            )
        if steps == config.settings.steps:
            return self
        if beyond := steps % config.settings.iteration_steps:
            more = steps - beyond + config.settings.iteration_steps
            raise LareError(f"steps = {steps} is not a multiple of {config.settings.described_iteration}: take {more}")
        settings = ResolvedSettings(**{**dict(config.settings), "steps": steps})
        longer = config.model_copy(update={"settings": settings, "ended_at": (*config.ended_at, config.settings.steps)})
        text = longer.model_dump_json(indent=1) + "\n"
        write_atomically(self.directory / CONFIG, lambda file: file.write(text.encode()))
        return replace(self, config=longer)

    def truncate(self, length: int) -> None:
        """Remove the lines that were written after a checkpoint; resumed training writes them again.

        Raises:
            LareError: lines from before it are missing.
        """
        path = self.directory / METRICS
        size = path.stat().st_size if path.exists() else 0
        if size < length:
            raise LareError(
                f"{path} has {size} bytes, and the checkpoint needs {length}: was the run copied while it was training?"
            )
        if size > length:
            os.truncate(path, length)


def create(directory: Path, task: TaskSpec, settings: ResolvedSettings, functions: Sequence[LatentFunction]) -> Run:
    """Create a new run directory. Raises `LareError` if the path exists."""
    config = describe(task, settings, functions)
    taken = LareError(
        f"{directory} exists, and a run never overwrites another: choose another directory, or continue "
        "the run with --resume (lare_rl.resume)"
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
        if directory.exists():  # another process has just made it
            raise taken from None
        raise LareError(f"the run directory {directory} cannot be made: {error.strerror}") from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return Run(directory, config, tuple(functions))


def default_directory(task: TaskSpec, settings: ResolvedSettings) -> Path:
    """runs/TASK-METHOD-ALGORITHM-sSEED, with a number appended if that exists."""
    name = f"{task.name}-{settings.method}-{settings.algorithm}-s{settings.seed}"
    number = 1
    while (directory := Path("runs") / (name if number == 1 else f"{name}-{number}")).exists():
        number += 1
    return directory


def read_config(directory: Path) -> Config:
    """The configuration of a run. Raises `LareError` if there is no run, or its configuration is not valid."""
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
    """Every complete line of a run's metrics.jsonl, in order. Raises `LareError` if a line is not valid, or cannot be read."""
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
    """The complete lines of a file; empty if there is no such file."""
    return read_text(path, LARGEST_METRICS).split("\n")[:-1] if path.exists() else []


def is_evaluation(line: Any) -> bool:
    """Whether it is a line of metrics.jsonl: a step, a seed, and numbers by name."""
    return (
        isinstance(line, dict)
        and all(type(line.get(name)) is int and 0 <= line[name] <= LARGEST_STEP for name in ("step", "seed"))
        and all(value is None or type(value) in (int, float) for value in line.values())
        and all(abs(value) <= LARGEST_STEP for value in line.values() if type(value) is int)
    )


def read_measured(directory: Path) -> Run:
    """A run for its metrics alone, without its functions. Raises `LareError` like `read_config`."""
    return Run(directory, read_config(directory), ())


def open_run(directory: str | Path) -> Run:
    """Read a run directory; its latent function is read and verified again.

    Raises:
        LareError: it is not a run, its files are not valid, or its environment is in a file that the user does not trust.
    """
    directory = Path(directory)
    config = read_config(directory)
    check_trusted(config.task, directory)
    places, since = function_places(directory, config)
    functions = tuple(load(place, role) for role, place in places)
    return Run(directory, config, functions, since)


def function_places(directory: Path, config: Config) -> tuple[list[tuple[TaskSpec, Path]], int]:
    """The file of the latent function of each role, and the step since which they have been in use. Nothing is executed.

    Raises:
        LareError: a file cannot be read, or was changed.
    """
    since, digests = 0, config.function_sha256
    if config.settings.reflect_every is not None and (host := saved_host(directory / CHECKPOINT)) is not None:
        since, digests = host.get("functions_since", 0), tuple(host.get("function_sha256", ()))
    if digests and len(digests) != len(config.task.roles):
        raise LareError(f"{directory}: there are {len(digests)} latent functions for {len(config.task.roles)} roles")
    places = []
    for role, digest in zip(config.task.roles, digests, strict=True) if digests else ():
        place = directory / function_file(config.task, role, since)
        if read_source(place).digest != digest:
            raise LareError(f"{place} is not the function that this run was trained with: its hash changed")
        places.append((role, place))
    return places, since


def as_run(given: Run | str | Path) -> Run:
    """A run, given itself or its directory. Raises `LareError` like `open_run`, and if it is neither."""
    if isinstance(given, Run):
        return given
    if isinstance(given, (str, Path)):
        return open_run(given)
    raise LareError(
        f"a run must be a directory, or come from lare_rl.train or lare_rl.open_run, and is {shortened(given)}"
    )


@contextlib.contextmanager
def locked(run: Run) -> Iterator[None]:
    """Keep a second process from training in the same directory, if the system has file locks."""
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
        except OSError:  # some network file systems have no locks
            pass
        yield
