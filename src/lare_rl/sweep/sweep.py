"""Many runs from one file: tasks x methods x algorithms x draws, the seeds of each in lockstep, each run a process of its own.

Finished runs are left alone, runs that have begun continue from their checkpoints, and missing runs are trained. So the same
command completes a sweep that was killed, and extends one whose file lists more runs than before.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from lare_rl.algorithms.table import Name
from lare_rl.config.settings import Settings, set_in_vain
from lare_rl.credit.methods import find_method
from lare_rl.envs.load import load_task
from lare_rl.errors import Checked, LareError
from lare_rl.sweep.cluster import on_ray
from lare_rl.sweep.jobs import Job, check, job_of
from lare_rl.sweep.processes import in_processes
from lare_rl.training.train import Interrupted
from lare_rl.util.safe_io import LARGEST_SETTINGS, read_text, read_toml

Texts = Annotated[tuple[str, ...], Field(min_length=1)]
Draws = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


class Share(Checked):
    """The part of the machine that runs use."""

    processes: Annotated[int, Field(ge=1)] = 1
    """Runs at a time."""
    cores: Annotated[int, Field(ge=1)] = 1
    """Cores of each run."""


class Sweep(Share):
    """The contents of the file. Paths are relative to it."""

    tasks: Texts
    """Shipped names, or paths of task files."""
    methods: Texts
    algorithms: tuple[Name, ...] = ()
    """The default is each task's own."""
    draws: Draws = (0,)
    """Draws of the recorded replies. Methods without a latent function are trained once."""
    functions: dict[str, tuple[Path, ...]] = Field(default_factory=dict)
    """Files of latent functions by the name of their task, one for each team. The default is the recorded functions."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Other settings of `lare-rl train`, such as steps and seeds."""
    out: Path | None = None
    """The directory for all runs. The default is `runs/NAME` beside the file NAME.toml."""

    @model_validator(mode="before")
    @classmethod
    def settings_in_their_table(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        for name in values.keys() - cls.model_fields.keys():
            if name in Settings.model_fields:
                raise ValueError(f"{name} is a setting: put it into the table [settings]")
        settings = values.get("settings")
        for name in settings if isinstance(settings, Mapping) else ():
            if name in ("method", "algorithm", "draw"):
                raise ValueError(f"{name} is not one of the settings: list {name}s above them")
            if name in cls.model_fields:
                raise ValueError(f"{name} is not one of the settings: write it above the table [settings]")
        return values


def read_sweep(path: Path) -> tuple[Sweep, list[Job]]:
    """Read a file, and check every run that it asks for before any is begun.

    Raises:
        LareError: it cannot be read, one of its runs could not be trained, or a setting makes no difference to any of them.
    """
    text = read_text(path, LARGEST_SETTINGS)
    try:
        values = read_toml(text)
        sweep = Sweep(**values)
        jobs = list(jobs_of(sweep, path))
    except (LareError, ValueError) as error:
        raise LareError(f"{path}: {error}") from error
    places: dict[Path, Job] = {}
    for job in jobs:
        if places.setdefault(job.directory, job) is not job:
            raise LareError(f"{path}: {job.name} is asked for twice; two task files need two names")
        check(job)
    in_vain = [set_in_vain(job.settings, job.resolved, job.task) for job in jobs]
    for name in in_vain[0]:
        if all(name in others for others in in_vain):
            head = f"{name} makes no difference to "
            whom = dict.fromkeys(others[name].removeprefix(head) for others in in_vain)
            raise LareError(f"{path}: {head}{', nor to '.join(whom)}")
    return sweep, jobs


def jobs_of(sweep: Sweep, path: Path) -> Iterator[Job]:
    """Every run of a sweep, task by task."""
    root = path.parent / (sweep.out or Path("runs") / path.stem)
    tasks = [load_task(path.parent / name if name.endswith(".toml") else name) for name in sweep.tasks]
    if unknown := sorted(sweep.functions.keys() - {task.name for task in tasks}):
        raise LareError(
            f"functions of {unknown[0]}, which is none of the tasks {', '.join(task.name for task in tasks)}"
        )
    if not any(find_method(method).latent for method in sweep.methods):
        for name, given in (("functions", bool(sweep.functions)), ("draws", sweep.draws != (0,))):
            if given:
                raise LareError(f"{name} are given, and none of the methods needs a latent function")
    if sweep.draws != (0,) and all(task.name in sweep.functions for task in tasks):
        raise LareError(
            "draws choose recorded functions, and every task is given functions of its own: leave either out"
        )
    for task, method, algorithm in product(tasks, sweep.methods, sweep.algorithms or (None,)):
        functions = [path.parent / function for function in sweep.functions.get(task.name, ())]
        draws = sweep.draws if find_method(method).latent and not functions else (0,)
        for draw in draws:
            settings = Settings(**{**sweep.settings, "method": method, "algorithm": algorithm, "draw": draw})
            try:
                yield job_of(root, task, settings, functions)
            except LareError as error:
                raise error if task.name in str(error) else LareError(f"on {task.name}, {error}") from error


def is_done(job: Job) -> bool:
    """Whether a job is done. A damaged run is not; its error is reported when it is trained."""
    try:
        return job.done
    except LareError:
        return False


def run_sweep(share: Share, jobs: Sequence[Job], said: Callable[[str], None], ray: str | None = None) -> list[Job]:
    """Train the jobs that are not done, on this machine or on a Ray cluster; returns the jobs that failed.

    Raises:
        Interrupted: the user stopped it.
        LareError: there are not enough cores, or Ray is not available.
    """
    missing = [job for job in jobs if not is_done(job)]
    done = len(jobs) - len(missing)
    said(f"{len(jobs)} runs, {done} of them done")
    if not missing:
        return []
    ended = (
        in_processes(missing, share.processes, share.cores, said) if ray is None else on_ray(missing, share.cores, ray)
    )
    failed = []
    try:
        with contextlib.closing(ended):
            for number, (job, error) in enumerate(ended, start=done + 1):
                said(f"{number} of {len(jobs)}: {job.name} {'failed: ' + error if error else 'is done'}")
                if error:
                    failed.append(job)
    except KeyboardInterrupt:
        raise Interrupted("stopped; all running runs were saved, and the same command continues them") from None
    return failed
