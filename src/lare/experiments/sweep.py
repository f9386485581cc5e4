"""Many runs from one file: tasks x methods x algorithms x draws, the seeds of each in lockstep, each run a process of its own.

What has come to its end is left alone, what was begun goes on from its checkpoint, what is missing is trained. So the same
command ends a sweep that was killed, and grows one whose file has got longer.
"""

import json
import logging
import os
import queue
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from lare.algorithms.table import Name
from lare.credit.methods import Encoder, find_method
from lare.errors import Checked, LareError
from lare.latent.design import CANDIDATES
from lare.tasks.spec import TaskSpec, load_task
from lare.training.run import CONFIG, read_config, read_metrics
from lare.training.settings import Plan, Settings, decide

Texts = Annotated[tuple[str, ...], Field(min_length=1)]
Draws = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


class Share(Checked):
    """Of the machine."""

    processes: Annotated[int, Field(ge=1)] = 1
    """Runs at a time."""
    cores: Annotated[int, Field(ge=1)] = 1
    """Of each run."""


class Sweep(Share):
    """What the file says. Paths are relative to it."""

    tasks: Texts
    """Shipped names, or paths of task files."""
    methods: Texts
    algorithms: tuple[Name, ...] = ()
    """Each task's own, unless given."""
    draws: Draws = (0,)
    """Of the recorded replies; methods without a latent function are trained once."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Whatever else `lare train` takes, as steps and seeds."""
    out: Path | None = None
    """The directory for all runs: `runs/NAME` beside a file NAME.toml, unless given."""


@dataclass(frozen=True)
class Job:
    """One run that is to be."""

    directory: Path
    task: TaskSpec
    plan: Plan

    @property
    def name(self) -> str:
        return f"{self.directory.parent.name}/{self.directory.name}"

    def step(self) -> int:
        """How far it is: the step of its last evaluation."""
        lines = read_metrics(self.directory)
        return lines[-1]["step"] if lines else 0

    @property
    def done(self) -> bool:
        return self.begun and self.step() == self.plan.steps

    @property
    def begun(self) -> bool:
        return (self.directory / CONFIG).is_file()


def read_sweep(path: Path) -> tuple[Sweep, list[Job]]:
    """Read a file, and check every run that it asks for before any is begun.

    Raises:
        LareError: it cannot be read, or one of its runs could not be trained.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        sweep = Sweep(**values)
        jobs = list(jobs_of(sweep, path))
    except OSError as error:
        raise LareError(f"{path} cannot be read: {error.strerror}") from error
    except (LareError, ValueError, RecursionError) as error:
        raise LareError(f"{path}: {error}") from error
    for job in jobs:
        check(job)
    return sweep, jobs


def jobs_of(sweep: Sweep, path: Path) -> Iterator[Job]:
    """Every run of a sweep, those of one task behind each other."""
    root = path.parent / (sweep.out or Path("runs") / path.stem)
    for name, method, algorithm in product(sweep.tasks, sweep.methods, sweep.algorithms or (None,)):
        task = load_task(path.parent / name if name.endswith(".toml") else name)
        draws = sweep.draws if find_method(method).encoder is Encoder.LATENT else sweep.draws[:1]
        for draw in draws:
            settings = Settings(**{**sweep.settings, "method": method, "algorithm": algorithm, "draw": draw})
            yield job_of(root, task, settings)


def job_of(root: Path, task: TaskSpec, settings: Settings) -> Job:
    """A run in its place: ROOT/TASK/METHOD-ALGORITHM, with the draw and an unusual number of candidates where they matter."""
    plan, ending = decide(settings, task), ""
    if find_method(plan.method).encoder is Encoder.LATENT:
        ending = f"-draw{plan.draw}" + (f"-candidates{plan.candidates}" if plan.candidates != CANDIDATES else "")
    return Job(root / task.name / f"{plan.method}-{plan.algorithm}{ending}", task, plan)


def check(job: Job) -> None:
    """Raise `LareError` where something else is in a job's place."""
    if job.begun:
        config = read_config(job.directory)
        if (config.settings, config.task.digest) != (job.plan, job.task.digest):
            raise LareError(f"{job.directory} holds a run of other settings or of another task: choose another out")
    elif job.directory.exists():
        # A run that was killed before it had a config.json holds latent functions, and nothing else.
        if any(not path.name.startswith("latent_function") for path in job.directory.iterdir()):
            raise LareError(f"{job.directory} exists, and is not a run: choose another out")
        shutil.rmtree(job.directory)


def run_sweep(share: Share, jobs: Sequence[Job], said: Callable[[str], None], ray: str | None = None) -> list[Job]:
    """Train what is not done, on this machine or on a Ray cluster; returns what failed.

    Raises:
        LareError: there are not as many cores, or Ray cannot be had.
    """
    missing = [job for job in jobs if not job.done]
    said(f"{len(jobs)} runs, {len(jobs) - len(missing)} of them done")
    train = on_ray if ray is not None else here
    failed = []
    for number, (job, error) in enumerate(train(share, missing, said, ray), start=len(jobs) - len(missing) + 1):
        said(f"{number} of {len(jobs)}: {job.name} {'failed: ' + error if error else 'is done'}")
        if error:
            failed.append(job)
    return failed


def here(
    share: Share, jobs: Sequence[Job], said: Callable[[str], None], _: str | None
) -> Iterator[tuple[Job, str | None]]:
    """Train on this machine, so many at a time, each on cores of its own."""
    slots: queue.Queue[list[int]] = queue.Queue()
    for cores in shares(share.processes, share.cores):
        slots.put(cores)
    running: set[subprocess.Popen] = set()

    def train(job: Job) -> str | None:
        cores = slots.get()
        said(f"{job.name} begins" + (f" again at step {job.step()}" if job.begun else ""))
        try:
            return in_a_process(job, cores, running)
        finally:
            slots.put(cores)

    with ThreadPoolExecutor(share.processes) as pool:
        futures = {pool.submit(train, job): job for job in jobs}
        try:
            yield from ((futures[future], future.result()) for future in as_completed(futures))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(running):
                process.send_signal(signal.SIGINT)
            raise LareError("stopped, and what was under way saved itself: the same command goes on") from None


def shares(processes: int, cores: int) -> list[list[int]]:
    """Which cores each process gets; none in particular where the system cannot say.

    Raises:
        LareError: there are not as many.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(processes)]
    usable = sorted(os.sched_getaffinity(0))
    if processes * cores > len(usable):
        raise LareError(
            f"processes = {processes} of cores = {cores} are {processes * cores} cores, and this machine lends {len(usable)}"
        )
    return [usable[place * cores : (place + 1) * cores] for place in range(processes)]


def in_a_process(job: Job, cores: list[int], running: set[subprocess.Popen]) -> str | None:
    """Train one run in a process of its own; returns what went wrong. What the process says is in RUN.log."""
    job.directory.parent.mkdir(parents=True, exist_ok=True)
    log = job.directory.with_name(job.directory.name + ".log")
    order = json.dumps({"job": as_json(job), "cores": cores})
    with log.open("a", encoding="utf-8") as file:
        command = [sys.executable, "-m", "lare.experiments.sweep"]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=file, stderr=file, text=True)
        running.add(process)
        try:
            process.communicate(order)
        finally:
            running.discard(process)
    if process.returncode == 0:
        return None
    lines = log.read_text(encoding="utf-8").splitlines() or [f"exit status {process.returncode}"]
    return f"{lines[-1]} ({log})"


def as_json(job: Job) -> dict[str, Any]:
    return {
        "directory": str(job.directory.absolute()),
        "task": job.task.model_dump(mode="json"),
        "settings": job.plan.model_dump(mode="json"),
    }


def train_one(order: dict[str, Any]) -> None:
    """Begin a run, or go on with it."""
    import lare

    directory = Path(order["directory"])
    if (directory / CONFIG).is_file():
        lare.resume(directory)
    else:
        lare.train(TaskSpec(**order["task"]), Settings(**order["settings"]), out=directory)


def on_ray(
    share: Share, jobs: Sequence[Job], said: Callable[[str], None], address: str | None
) -> Iterator[tuple[Job, str | None]]:
    """Train on a Ray cluster, each run with its number of cores; the directory must be one that all machines see."""
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise LareError("a Ray cluster needs an extra: pip install 'lare-rl[ray]'") from None
    try:
        ray.init(
            None if address == "local" else address,
            log_to_driver=False,
            include_dashboard=False,
            logging_level=logging.ERROR,
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise LareError(f"there is no Ray cluster at {address}: {error}") from error
    try:
        remote = ray.remote(num_cpus=share.cores, max_calls=1)(train_one)
        waiting = {remote.remote(as_json(job)): job for job in jobs}
        while waiting:
            (ended,), _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(ended)
            try:
                ray.get(ended)
                yield job, None
            except RayError as error:
                yield job, str(error).strip().splitlines()[-1]
    finally:
        ray.shutdown()


def main() -> None:
    """What `in_a_process` starts: one run, told on standard input."""
    order = json.load(sys.stdin)
    if order["cores"]:
        os.sched_setaffinity(0, order["cores"])
    try:
        train_one(order["job"])
    except LareError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)


if __name__ == "__main__":
    main()
