"""Sweeps: runs of tasks x methods x algorithms x draws from one file. All seeds of a run are trained in one process.

Finished runs are skipped, and unfinished runs continue from their checkpoints. So the same command continues a sweep that was killed,
and extends a sweep whose file lists further runs.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from lare_rl.config.effective import describe_unused_settings
from lare_rl.config.settings import Settings
from lare_rl.credit.methods import METHODS
from lare_rl.envs.load import load_task, resolve_path
from lare_rl.errors import LareError
from lare_rl.runs.plan import FunctionPaths
from lare_rl.sweep.jobs import Job, check_job, make_job
from lare_rl.sweep.processes import train_in_processes, train_on_ray
from lare_rl.sweep.resources import Resources
from lare_rl.training.train import RunInterruptedError
from lare_rl.util.renamed_fields import rename_keys
from lare_rl.util.safe_io import read_table

__all__ = ["read_sweep", "run_sweep"]

Names = Annotated[tuple[str, ...], Field(min_length=1)]
Draws = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


class Sweep(Resources):
    """The contents of a sweep's file. Paths are relative to the file."""

    tasks: Names
    """Shipped names, or paths of task files."""
    methods: Names
    algorithms: tuple[str, ...] = ()
    """By default, the algorithm of each task."""
    draws: Draws = (0,)
    """Draws of the latent functions from the recorded replies. Methods without a latent function are trained once."""
    functions: dict[str, FunctionPaths] = Field(default_factory=dict)
    """Files of latent functions by the name of their task: one, or one for each team. By default, recorded replies are used."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Other settings of `lare-rl train`, such as steps and seeds."""
    out: Path | None = None
    """The directory for all runs. The default is `runs/NAME` in the directory of the file NAME.toml."""

    @model_validator(mode="before")
    @classmethod
    def _check_tables(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        settings = values["settings"] if isinstance(values.get("settings"), Mapping) else {}
        for name in ("method", "algorithm", "draw"):
            if name in values or name in settings:
                raise ValueError(f"{name} is chosen by a list: write {name}s = [...] above all tables")
        for name in sorted(values.keys() - cls.model_fields.keys()):
            if name in Settings.model_fields:
                raise ValueError(f"{name} is a setting: write it into the table [settings]")
        for name in settings:
            if name in cls.model_fields:
                raise ValueError(f"{name} is not a setting of a run: write it above all tables")
        return values


def read_sweep(path: Path) -> tuple[Sweep, list[Job]]:
    """Read a file, and check all of its runs before any is trained.

    Raises `LareError` if the file cannot be read, a run could not be trained, or a setting affects no run.
    """
    table = read_table(path)
    try:
        sweep = Sweep(**rename_keys(table))
        _check_phi_is_used(sweep)
        jobs = list(_make_jobs(sweep, path))
        directories: set[Path] = set()
        for job in jobs:
            if job.directory in directories:
                raise LareError(
                    f"{job.name} is listed twice: remove one, or, if these are two task files, give them different names"
                )
            directories.add(job.directory)
            check_job(job)
        _check_settings(jobs)
    except LareError as error:
        raise LareError(f"{path}: {error}") from error
    return sweep, jobs


def run_sweep(
    resources: Resources, jobs: Sequence[Job], listener: Callable[[str], None], ray: str | None = None
) -> list[Job]:
    """Train the jobs that are not done, on this machine or on a Ray cluster. Return the jobs that failed.

    Args:
        resources: what each run uses, such as a `Sweep`.
        jobs: the runs.
        listener: called with messages.
        ray: the address of a Ray cluster, or "local"; None: this machine, without Ray.

    Raises:
        RunInterruptedError: the user pressed Ctrl-C.
        LareError: there are not enough cores or accelerators, or Ray is not available.
    """
    todo = [job for job in jobs if not job.done]
    n_done = len(jobs) - len(todo)
    listener(f"{len(jobs)} runs, {n_done} of them done")
    if not todo:
        return []
    results = train_in_processes(todo, resources, listener) if ray is None else train_on_ray(todo, resources, ray)
    failed = []
    try:
        with contextlib.closing(results):
            for number, (job, error) in enumerate(results, start=n_done + 1):
                listener(f"{number} of {len(jobs)}: {job.name} {f'failed: {error}' if error else 'is done'}")
                if error:
                    failed.append(job)
    except KeyboardInterrupt:
        saved = "the running runs were asked to save, and the same command continues them"
        if ray is not None:  # which does not ask them to save
            saved = "the same command continues the runs from their last checkpoints"
        raise RunInterruptedError(f"stopped; {saved}") from None
    return failed


def _check_phi_is_used(sweep: Sweep) -> None:
    """Raise `LareError` if draws or functions affect no run."""
    if any(METHODS.find(method).needs_phi for method in sweep.methods):
        return
    for name, is_set in (("functions", bool(sweep.functions)), ("draws", sweep.draws != (0,))):
        if is_set:
            raise LareError(f"no method of the sweep has a latent function: leave out {name}")


def _make_jobs(sweep: Sweep, path: Path) -> Iterator[Job]:
    """Plan every run of a sweep, task by task."""
    root = path.parent / (sweep.out or Path("runs") / path.stem)
    tasks = [load_task(resolve_path(str(path), name)) for name in sweep.tasks]
    names = [task.name for task in tasks]
    if unknown := sorted(sweep.functions.keys() - set(names)):
        raise LareError(f"[functions] names the task {unknown[0]}, but the tasks are {', '.join(names)}")
    if sweep.draws != (0,) and sweep.functions.keys() >= set(names):
        raise LareError(
            "draws choose recorded replies, but all tasks have functions in [functions]: remove draws, or remove [functions]"
        )
    for task, method, algorithm in product(tasks, sweep.methods, sweep.algorithms or (None,)):
        functions = [path.parent / function for function in sweep.functions.get(task.name, ())]
        for draw in sweep.draws if METHODS.find(method).needs_phi and not functions else (0,):
            chosen = {"method": method, "algorithm": algorithm, "draw": draw}
            settings = Settings(**sweep.settings | chosen)
            try:
                yield make_job(root, task, settings, functions)
            except LareError as error:
                if task.name in str(error):
                    raise
                raise LareError(f"on {task.name}, {error}") from error


def _check_settings(jobs: Sequence[Job]) -> None:
    """Raise `LareError` if a setting affects none of the jobs."""
    unused = [describe_unused_settings(job.settings, job.resolved, job.task) for job in jobs]
    for name, message in unused[0].items():
        if all(name in messages for messages in unused):
            raise LareError(f"no run uses {name}; in the first, {message}")
