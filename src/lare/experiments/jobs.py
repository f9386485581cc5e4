"""Runs that are to be: each in its place, begun or not, and how it is trained."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lare
from lare.credit.methods import find_method
from lare.errors import LareError
from lare.latent.design import CANDIDATES
from lare.tasks.spec import TaskSpec
from lare.training.checkpoint import saved_step
from lare.training.run import CHECKPOINT, CONFIG, read_config, read_metrics
from lare.training.settings import Plan, Settings, decide


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
        """Whether every seed has come to its end, and the checkpoint with them, where one has been kept."""
        if not self.begun:
            return False
        ended = {line["seed"] for line in read_metrics(self.directory) if line["step"] == self.plan.steps}
        saved = saved_step(self.directory / CHECKPOINT)
        return ended == set(self.plan.all_seeds) and saved in (None, self.plan.steps)

    @property
    def begun(self) -> bool:
        return (self.directory / CONFIG).is_file()


def job_of(root: Path, task: TaskSpec, settings: Settings) -> Job:
    """A run in its place: ROOT/TASK/METHOD-ALGORITHM, with the draw and an unusual number of candidates where they matter."""
    plan, ending = decide(settings, task), ""
    if find_method(plan.method).latent:
        ending = f"-draw{plan.draw}" + (f"-candidates{plan.candidates}" if plan.candidates != CANDIDATES else "")
    return Job(root / task.name / f"{plan.method}-{plan.algorithm}{ending}", task, plan)


def check(job: Job) -> None:
    """Raise `LareError` where something else is in a job's place."""
    if job.begun:
        config = read_config(job.directory)
        if config.task.digest != job.task.digest:
            raise LareError(f"{job.directory} holds a run of another task: choose another out")
        theirs, ours = config.settings.in_force(config.task), job.plan.in_force(job.task)
        if differing := [name for name in ours if theirs.get(name) != ours[name]]:
            name = differing[0]
            raise LareError(
                f"{job.directory} holds a run with {name} = {theirs.get(name)}, and {ours[name]} is asked for: choose another out"
            )
    elif job.directory.exists():
        # A run that was killed before it had a config.json holds latent functions, and nothing else.
        if any(not path.name.startswith("latent_function") for path in job.directory.iterdir()):
            raise LareError(f"{job.directory} exists, and is not a run: choose another out")
        shutil.rmtree(job.directory)


def as_json(job: Job) -> dict[str, Any]:
    return {
        "directory": str(job.directory.absolute()),
        "task": job.task.model_dump(mode="json"),
        "settings": job.plan.model_dump(mode="json"),
    }


def train_one(order: dict[str, Any]) -> None:
    """Begin a run, or go on with it."""
    directory = Path(order["directory"])
    if (directory / CONFIG).is_file():
        lare.resume(directory)
    else:
        lare.train(TaskSpec(**order["task"]), Settings(**order["settings"]), out=directory)
