"""Planned runs (jobs): the directory of each, how far it is, and how it is trained."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lare_rl
from lare_rl.config.resolve import decide
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.methods import find_method
from lare_rl.envs.families import env_spec
from lare_rl.errors import LareError
from lare_rl.latent.candidates import CANDIDATES
from lare_rl.latent.design import check_recorded
from lare_rl.runs.checkpoint import saved_host
from lare_rl.runs.directory import CHECKPOINT, CONFIG, read_config, read_metrics
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.train import chosen_functions


@dataclass(frozen=True)
class Job:
    """A planned run."""

    directory: Path
    task: TaskSpec
    settings: Settings
    """As the user gave them."""
    resolved: ResolvedSettings
    functions: tuple[Path, ...] = ()
    """Files of latent functions to use instead of recorded ones: one for each team."""

    @property
    def name(self) -> str:
        return f"{self.directory.parent.name}/{self.directory.name}"

    def step(self) -> int:
        """The step of the checkpoint; without one, of the last evaluation, or 0."""
        if (saved := saved_host(self.directory / CHECKPOINT)) is not None:
            return saved["step"]
        lines = read_metrics(self.directory)
        return lines[-1]["step"] if lines else 0

    @property
    def done(self) -> bool:
        """Whether every seed has reached the last step, and so has the checkpoint, if there is one."""
        if not self.begun:
            return False
        ended = {line["seed"] for line in read_metrics(self.directory) if line["step"] == self.resolved.steps}
        saved = saved_host(self.directory / CHECKPOINT)
        return ended == set(self.resolved.all_seeds) and (saved is None or saved["step"] == self.resolved.steps)

    @property
    def begun(self) -> bool:
        return (self.directory / CONFIG).is_file()


def job_of(root: Path, task: TaskSpec, settings: Settings, functions: Sequence[Path] = ()) -> Job:
    """The job in ROOT/TASK/METHOD-ALGORITHM. The name of a recorded function's draw, and of an unusual number of candidates,
    follows.
    """
    resolved = decide(settings, task)
    ending = ""
    latent = find_method(resolved.method).latent
    if latent and not functions:
        ending = f"-draw{resolved.draw}"
        ending += f"-candidates{resolved.candidates}" if resolved.candidates != CANDIDATES else ""
    name = f"{resolved.method}-{resolved.algorithm}{ending}"
    return Job(root / task.name / name, task, settings, resolved, tuple(functions) if latent else ())


def check(job: Job) -> None:
    """Raise `LareError` if a job could not be trained, or if its directory holds something else."""
    method = find_method(job.resolved.method)
    functions = chosen_functions(job.task, job.resolved, job.functions) if job.functions else ()
    if job.begun:
        config = read_config(job.directory)
        if config.task.digest != job.task.digest:
            raise LareError(f"{job.directory} holds a run of another task: choose another out")
        theirs, ours = config.settings.in_force(config.task), job.resolved.in_force(job.task)
        if differing := [name for name in ours if theirs.get(name) != ours[name]]:
            name = differing[0]
            raise LareError(
                f"{job.directory} holds a run with {name} = {theirs.get(name)}, and {ours[name]} is asked for: choose another out"
            )
        if functions and config.function_sha256 != tuple(function.digest for function in functions):
            raise LareError(f"{job.directory} holds a run with another latent function: choose another out")
    elif job.directory.exists():
        raise LareError(f"{job.directory} exists, and is not a run: choose another out")
    else:
        for role in job.task.roles if method.latent and not functions else ():
            check_recorded(role, method.kind, job.resolved.draw, job.resolved.candidates)


def as_json(job: Job) -> dict[str, Any]:
    return {
        "directory": str(job.directory.absolute()),
        "task": job.task.model_dump(mode="json"),
        "settings": job.settings.model_dump(mode="json"),
        "functions": [str(path.absolute()) for path in job.functions],
    }


def train_one(order: dict[str, Any]) -> None:
    """Begin a run, or resume it."""
    directory = Path(order["directory"])
    if (directory / CONFIG).is_file():
        env_spec(TaskSpec(**order["task"]))  # imports the module of the user's task, so that the run may too
        lare_rl.resume(directory)
    else:
        settings = Settings(**order["settings"])
        lare_rl.train(TaskSpec(**order["task"]), settings, function=order["functions"] or None, out=directory)
