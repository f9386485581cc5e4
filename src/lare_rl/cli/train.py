"""The command `train`."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import Positional
from tyro.constructors import PrimitiveConstructorSpec

from lare_rl.cli.terminal import print_line, print_progress
from lare_rl.config.effective import describe_unused_settings
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.errors import LareError
from lare_rl.runs.plan import RunPlan, load_config
from lare_rl.tasks.trust import command_line

if TYPE_CHECKING:
    from lare_rl.latent.function import LatentFunction
    from lare_rl.runs.directory import Run
    from lare_rl.tasks.spec import TaskSpec
    from lare_rl.training.progress import Listener

DEFAULTS = Settings()
ALGORITHM_DEFAULTS = "environments", "rollout_steps", "evaluate_every", "fit_updates", "capacity"
"""Settings whose defaults the algorithm chooses."""

_READ_PLAN = PrimitiveConstructorSpec(
    nargs=1,
    metavar="FILE",
    instance_from_str=lambda paths: load_config(paths[0]),
    is_instance=lambda value: value is None or isinstance(value, RunPlan),
    str_from_instance=lambda plan: [str(plan)],
)
"""Reads the file or the run that --config names. `cli/parse.py` then puts the options of the command line over its settings."""


def train(
    task: Annotated[Positional[str | None], tyro.conf.arg(metavar="[TASK]")] = None,
    settings: Annotated[Settings, tyro.conf.arg(name="")] = DEFAULTS,
    function: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = (),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    config: Annotated[RunPlan | None, _READ_PLAN] = None,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    tensorboard: bool = False,
    wandb: Annotated[str | None, tyro.conf.arg(metavar="PROJECT")] = None,
    mlflow: Annotated[str | None, tyro.conf.arg(metavar="EXPERIMENT")] = None,
) -> None:
    """Train on a task's episodic rewards. Ctrl-C saves and stops; --resume continues.

    The help lists the hyperparameters of an algorithm if it is named, as in lare-rl train --algorithm ppo --help.

    Args:
        task: a shipped name (see `lare-rl tasks`), or the path of a task file. Not given with --resume.
        function: a latent function (.py), or a reply with one (.json), to use instead of a recorded one; verified before it is
            run. Where several teams learn, one --function for each, in the order of the task.
        out: the run directory, which must not exist; the default is runs/TASK-METHOD-ALGORITHM-sSEED.
        config: a TOML or JSON file with task, function, out and any of the settings, or the directory of a run to repeat. The options of
            the command line win.
        resume: a run directory to continue, from its last checkpoint and with its own settings. With --steps, a finished run is
            extended.
        tensorboard: write TensorBoard events into the run directory too (needs the extra lare-rl[tensorboard]).
        wandb: send the metrics of each seed to a project of Weights & Biases too (needs the extra lare-rl[wandb]).
        mlflow: send the metrics of each seed to an experiment of MLflow too (needs the extra lare-rl[mlflow]).
    """
    plan = config or RunPlan()
    chosen_task = task or plan.task
    if isinstance(chosen_task, str):
        from lare_rl.envs.load import read_task

        read_task(chosen_task)  # a typo is reported before the slow imports
    if resume is not None:
        import lare_rl
        from lare_rl.runs.directory import open_run

        options = (task, function, out, config, settings.model_copy(update={"steps": None}))
        if options != (None, (), None, None, DEFAULTS):
            raise LareError(
                "--resume continues a run in its directory, with its own task, settings and functions: leave out TASK, --function, "
                "--out, --config and all settings but --steps"
            )
        stopped = open_run(resume)
        run_settings = stopped.config.settings
        start = partial(lare_rl.resume, stopped, steps=settings.steps)
    elif chosen_task is None:
        raise LareError(
            f"there is no task{f' in {plan.source}' if config else ''}: use lare-rl train TASK (lare-rl tasks lists them), "
            "or lare-rl train --resume DIR"
        )
    else:
        start, run_settings = _prepare(chosen_task, settings, function, out or plan.out, plan)
    run = start(tensorboard=tensorboard, listeners=_listeners(wandb, mlflow, run_settings))
    print_line(f"finished {run.directory}; to see it: {command_line(run.config.task, 'report', run.directory)}")


def _prepare(
    task: "str | TaskSpec", settings: Settings, function: Sequence[Path], out: Path | None, plan: RunPlan
) -> "tuple[Callable[..., Run], ResolvedSettings]":
    """Return the function that starts a new run, and its settings."""
    import lare_rl
    from lare_rl.config.resolve import resolve
    from lare_rl.envs.load import resolve_task
    from lare_rl.runs.directory import default_directory

    spec = resolve_task(task)
    resolved = resolve(settings, spec)
    if plan.is_run and resolved.algorithm != plan.settings.algorithm:
        names = [name for name in ALGORITHM_DEFAULTS if plan.has_same_value(name, settings)]
        values = ", ".join(f"{name} = {getattr(resolved, name)}" for name in names)
        print_progress(f"from the run, which was trained with {plan.settings.algorithm}: {values or 'nothing'}")
    for name, warning in describe_unused_settings(settings, resolved, spec).items():
        # The configuration of a repeated run holds every setting, so a setting without effect is no mistake of the user.
        if not (plan.is_run and plan.has_same_value(name, settings)):
            raise LareError(f"leave {name} out: {warning}")
    files = function or plan.function_for(resolved)
    functions = _load_functions(files, spec, resolved) if files else None
    out = out or default_directory(spec, resolved)
    return partial(lare_rl.train, spec, settings, function=functions, out=out), resolved


def _load_functions(
    files: "Sequence[Path | LatentFunction]", spec: "TaskSpec", resolved: ResolvedSettings
) -> "Sequence[LatentFunction]":
    """Load and verify the latent functions of a run. Report a function that was changed by hand."""
    from lare_rl.latent.function import CHANGED_SUFFIX
    from lare_rl.training.latent_functions import choose_functions

    functions = choose_functions(spec, resolved, files)
    for function in functions:
        if function.changed:
            author = function.model.removesuffix(CHANGED_SUFFIX)
            print_progress(f"the function by {author} was changed after it was saved: its hash differs")
    return functions


def _listeners(wandb: str | None, mlflow: str | None, settings: ResolvedSettings) -> "list[Listener]":
    """Return the terminal, and the requested tracking services."""
    from lare_rl.training.progress import Terminal
    from lare_rl.training.trackers import MLflow, WeightsAndBiases

    listeners: list[Listener] = [Terminal()]
    values = settings.model_dump(mode="json")
    if wandb is not None:
        listeners.append(WeightsAndBiases(project=wandb, config=values))
    if mlflow is not None:
        listeners.append(MLflow(mlflow, parameters=values))
    return listeners
