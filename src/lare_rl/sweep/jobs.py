"""Jobs, which are planned runs: their directories, their progress, and their training."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lare_rl
from lare_rl.config.effective import effective_settings
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.credit.methods import METHODS
from lare_rl.errors import LareError
from lare_rl.latent.design import check_recorded
from lare_rl.llm.prompts import N_CANDIDATES
from lare_rl.runs.checkpoint import read_metadata
from lare_rl.runs.config_file import CONFIG, read_config
from lare_rl.runs.directory import CHECKPOINT
from lare_rl.runs.metrics_file import read_metrics
from lare_rl.tasks.spec import TaskSpec
from lare_rl.tasks.trust import command_line, trust_environment
from lare_rl.training.latent_functions import choose_functions

__all__ = ["Job", "check_job", "describe_job", "make_job", "train_job"]

ANOTHER_OUT = "choose another directory for the runs (in a sweep's file: out; for lare-rl reproduce: --runs)"


@dataclass(frozen=True)
class Job:
    """A planned run."""

    directory: Path
    task: TaskSpec
    settings: Settings
    """The settings that the user chose."""
    resolved: ResolvedSettings
    """These settings with all defaults."""
    functions: tuple[Path, ...] = ()
    """Files of latent functions, one for each team. Empty if the recorded replies are used, or if the method has no phi."""

    @property
    def name(self) -> str:
        """TASK/RUN, the end of the directory's path."""
        return f"{self.directory.parent.name}/{self.directory.name}"

    @property
    def started(self) -> bool:
        """Whether the directory holds a run."""
        return (self.directory / CONFIG).is_file()

    def step(self) -> int:
        """Return the step of the checkpoint or, if none can be read, of the last evaluation.

        Raises `LareError` if the metrics are damaged.
        """
        if (checkpoint := read_metadata(self.directory / CHECKPOINT)) is not None:
            return checkpoint["step"]
        lines = read_metrics(self.directory)
        return lines[-1]["step"] if lines else 0

    @property
    def done(self) -> bool:
        """Whether every seed has reached the last step. False if the metrics are damaged: training then reports the error."""
        last_step = self.resolved.steps
        try:
            seeds = {line["seed"] for line in read_metrics(self.directory) if line["step"] == last_step}
            return self.started and seeds == set(self.resolved.all_seeds) and self.step() == last_step
        except LareError:
            return False


def make_job(root: Path, task: TaskSpec, settings: Settings, functions: Sequence[Path] = ()) -> Job:
    """Plan a run in ROOT/TASK/METHOD-ALGORITHM[-drawK][-candidatesN]. Raises `LareError` if settings and task do not fit together.

    The name of a run with a recorded `phi` has its draw, and the number of candidates if it is not the default.
    """
    resolved = resolve(settings, task)
    name = f"{resolved.method}-{resolved.algorithm}"
    needs_phi = METHODS.find(resolved.method).needs_phi
    if needs_phi and not functions:
        name += f"-draw{resolved.draw}"
        if resolved.candidates != N_CANDIDATES:
            name += f"-candidates{resolved.candidates}"
    return Job(
        directory=root / task.name / name,
        task=task,
        settings=settings,
        resolved=resolved,
        functions=tuple(functions) if needs_phi else (),
    )


def check_job(job: Job) -> None:
    """Raise `LareError` if a job cannot be trained, or if its directory holds another run or other files."""
    method = METHODS.find(job.resolved.method)
    functions = choose_functions(job.task, job.resolved, job.functions) if job.functions else ()
    if not job.started:
        if job.directory.exists():
            raise LareError(f"{job.directory} exists, and is not a run: {ANOTHER_OUT}")
        if method.needs_phi and not functions:
            for role in job.task.roles:
                check_recorded(role, method.phi_kind, job.resolved.draw, job.resolved.candidates)
        return
    config = read_config(job.directory)
    if config.task != job.task:
        raise LareError(f"{job.directory} holds a run of another task: {ANOTHER_OUT}")
    old, new = effective_settings(config.settings), effective_settings(job.resolved)
    different_names = [name for name, value in new.items() if old.get(name) != value]
    if different_names:
        name = different_names[0]
        command = command_line(job.task, "train", "--resume", job.directory, "--steps", new["steps"])
        can_extend = different_names == ["steps"] and new["steps"] > old["steps"]
        hint = f"extend it with {command}, or {ANOTHER_OUT}" if can_extend else ANOTHER_OUT
        raise LareError(f"{job.directory} holds a run with {name} = {old.get(name)}, not {new[name]}: {hint}")
    if functions and config.function_sha256 != tuple(function.digest for function in functions):
        raise LareError(f"{job.directory} holds a run with another latent function: {ANOTHER_OUT}")


def describe_job(job: Job) -> dict[str, Any]:
    """Describe a job for `train_job` in another process."""
    return {
        "directory": str(job.directory.absolute()),
        "task": job.task.model_dump(mode="json"),
        "settings": job.settings.model_dump(mode="json", exclude_unset=True),
        "functions": [str(path.absolute()) for path in job.functions],
    }


def train_job(description: dict[str, Any]) -> None:
    """Train the run that `describe_job` describes, or resume it."""
    directory, task = Path(description["directory"]), TaskSpec(**description["task"])
    if (directory / CONFIG).is_file():
        trust_environment(task)  # resume reads the task from the directory, and this one comes from the user
        read_metrics(directory)  # raises an error if they are damaged, which resume of a finished run does not notice
        lare_rl.resume(directory)
    else:
        lare_rl.train(
            task, Settings(**description["settings"]), function=description["functions"] or None, out=directory
        )
