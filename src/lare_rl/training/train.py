"""Trains a run from its start, or from its last checkpoint, to its end."""

import contextlib
import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp

from lare_rl.config.effective import unused_settings, warmup_warning
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.envs.load import resolve_task
from lare_rl.envs.workers import close_idle_workers
from lare_rl.errors import LareError, short_repr
from lare_rl.runs.config_file import read_config
from lare_rl.runs.directory import Run, as_run, create_run, default_directory, extend_run, lock_run
from lare_rl.runs.metrics_file import truncate_metrics
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training.collect_device import DeviceCollector, is_reset_cheap, make_jax_env
from lare_rl.training.collect_host import make_host_collector
from lare_rl.training.compiled import compile_ahead, init_seeds, is_batching_faster
from lare_rl.training.iteration import compile_loop
from lare_rl.training.latent_functions import FunctionOrPath, choose_functions
from lare_rl.training.learner import Learner
from lare_rl.training.loop import run_session
from lare_rl.training.process import catch_stop_signals, report_full_memory
from lare_rl.training.progress import Listener, TensorBoard, Terminal, import_summary_writer
from lare_rl.training.saved_state import load_learner
from lare_rl.training.seed_axis import count_seed_devices
from lare_rl.training.session import Session
from lare_rl.training.static_config import TrainConfig, make_train_config
from lare_rl.training.streams import seed_keys
from lare_rl.util import compilation
from lare_rl.util.npz import DAMAGED_FILE_ERRORS

__all__ = ["restore_session", "resume", "start_session", "train"]

EVENTS_DIRECTORY = "tensorboard"
"""Within the run directory."""


def train(
    task: str | Path | TaskSpec,
    settings: Settings | None = None,
    *,
    function: FunctionOrPath | Sequence[FunctionOrPath] | None = None,
    out: str | Path | None = None,
    tensorboard: bool = False,
    listeners: Sequence[Listener] | None = None,
) -> Run:
    """Train on a task's episodic rewards.

    Args:
        task: a shipped name, the path of a TOML file, or a spec.
        settings: method, algorithm, steps, seeds and all the rest.
        function: `phi`, or the path of its file, for the methods that need one; one for each team if several learn. By default,
            `phi` is designed from the shipped recordings.
        out: the run directory, which must not exist; the default is `runs/...`.
        tensorboard: also write every number of metrics.jsonl as TensorBoard events, with the extra `lare-rl[tensorboard]`.
        listeners: objects that receive the progress; the default is the terminal.

    Raises:
        LareError: an argument cannot be used, or an environment or function failed. The files of the run are then still
            complete, and `resume` continues from the last checkpoint.
    """
    if tensorboard:
        import_summary_writer()  # an error before the run directory is created
    if not isinstance(settings, Settings | None):
        raise LareError(
            "settings must be a lare_rl.Settings, such as lare_rl.Settings(method='rrdu', steps=100_000), and are "
            f"{short_repr(settings)}"
        )
    task, settings, listeners = resolve_task(task), settings or Settings(), _check_listeners(listeners)
    resolved = resolve(settings, task)
    functions = choose_functions(task, resolved, function)
    run = create_run(Path(out) if out is not None else default_directory(task, resolved), task, resolved, functions)
    unused = list(unused_settings(settings, resolved, task).values())
    messages = unused[:1] if len(unused) < 2 else [f"{unused[0]} (and {len(unused) - 1} more)"]
    messages += _describe_rounding(resolved, steps=settings.steps, evaluate_every=settings.evaluate_every)
    with lock_run(run), report_full_memory(run), catch_stop_signals() as stop:
        _prepare(run, listeners)
        session = start_session(run)
        try:
            session.save()  # so that there is always a checkpoint
            return _finish(session, tensorboard, listeners, stop, messages)
        finally:
            _close(session)


def resume(
    run: Run | str | Path,
    *,
    steps: int | None = None,
    tensorboard: bool = False,
    listeners: Sequence[Listener] | None = None,
) -> Run:
    """Continue a run that was stopped or killed, from its last checkpoint to its end; or extend it.

    On the CPU, the metrics are the same, bit for bit, as those of a run that was never stopped (except the times).

    Args:
        steps: a new number of environment steps of each seed, to extend the run, rounded up to whole iterations. Schedules over the
            whole run (`ppo.anneal`) then go by the new number.
        tensorboard: also write TensorBoard events. A run that has some always continues them.
        listeners: objects that receive the progress; the default is the terminal.

    Raises:
        LareError: it is not a run, its checkpoint was deleted, or `steps` is smaller than before; and as in `train`.
    """
    run, steps, listeners = as_run(run), Settings(steps=steps).steps, _check_listeners(listeners)
    tensorboard = tensorboard or (run.directory / EVENTS_DIRECTORY).is_dir()
    if tensorboard:
        import_summary_writer()
    with lock_run(run), report_full_memory(run), catch_stop_signals() as stop:
        run = replace(run, config=read_config(run.directory))  # it may have been extended since it was opened
        if not run.has_checkpoint() and run.metrics():  # the checkpoint was deleted
            raise LareError(f"{run.directory} has no checkpoint any more, and cannot be resumed: start a new run")
        earlier_steps = run.config.settings.steps
        run = run if steps is None else extend_run(run, steps)
        messages = _describe_rounding(run.config.settings, steps=steps)
        _prepare(run, listeners)
        is_new = not run.has_checkpoint()
        session, restored = (start_session(run), []) if is_new else restore_session(run)
        try:
            if is_new:
                session.save()
            else:
                truncate_metrics(run.directory, session.metrics_bytes)
            messages += [*restored, *_describe_annealing(session, earlier_steps)]
            return _finish(session, tensorboard, listeners, stop, messages)
        finally:
            _close(session)


def _describe_rounding(resolved: ResolvedSettings, **requested: int | None) -> list[str]:
    """Return a message about each number of steps that was rounded up to whole iterations."""
    iteration = f"an iteration has {resolved.iteration_steps:,} steps (rollout_steps)"
    return [
        f"{name} = {steps:,} is rounded up to {rounded:,}: {iteration}"
        for name, steps in requested.items()
        if steps is not None and (rounded := getattr(resolved, name)) != steps
    ]


def _describe_annealing(session: Session, earlier_steps: int) -> list[str]:
    """Return a message if a run is extended whose learning rate fell towards 0."""
    settings, step = session.settings, session.step
    if not (step and settings.steps > earlier_steps and getattr(settings.hyperparameters, "anneal", False)):
        return []
    return [
        f"{settings.algorithm}.anneal: the learning rate had fallen to {max(0, 1 - step / earlier_steps):.0%} of its initial value, and "
        f"falls again from {1 - step / settings.steps:.0%}, so the result is not that of one long run; a run that began with "
        f"--{settings.algorithm}.no-anneal can be extended"
    ]


def _check_listeners(listeners: Sequence[Listener] | None) -> list[Listener]:
    """Return the listeners, or the terminal. Raise `LareError` if an object is not a listener."""
    if not isinstance(listeners, Iterable | None):
        raise LareError(f"listeners must be a list, and are {short_repr(listeners)}")
    checked: list[Listener] = [Terminal()] if listeners is None else list(listeners)
    for listener in checked:
        if isinstance(listener, type) or not isinstance(listener, Listener):
            raise LareError(
                "a listener must be an object with the methods on_start, on_step, on_evaluation, on_message and on_stop "
                f"(lare_rl.training.progress.Listener), and {short_repr(listener)} is not"
            )
    return checked


def _prepare(run: Run, listeners: Sequence[Listener]) -> None:
    """Turn on the compilation cache, and tell the listeners how long compiling takes."""
    for listener in listeners:
        listener.on_message(
            f"preparing {run.directory}: compiling takes about half a minute, or about ten seconds if it was done before"
        )
    compilation.enable_cache()


def start_session(run: Run) -> Session:
    """Return a session before its first step."""
    config = replace(make_train_config(run), n_devices=count_seed_devices(len(run.seeds)))
    config = replace(config, batched=is_batching_faster(config, len(run.seeds)))
    return _make_session(run, config, None)


def restore_session(run: Run) -> tuple[Session, list[str]]:
    """Return a session at the last checkpoint, and messages for the user.

    Raises:
        LareError: there is no checkpoint, or it cannot be used.
    """
    config, learner, metadata, arrays = load_learner(run, count_seed_devices(len(run.seeds)))
    session = _make_session(run, config, learner)
    try:
        return session, session.restore(metadata, arrays)
    except BaseException as error:
        _close(session)
        if not isinstance(error, DAMAGED_FILE_ERRORS):
            raise
        raise LareError(
            f"the checkpoint in {run.checkpoint} does not fit its environments ({type(error).__name__}: {error}): start a new run, or "
            "install the version that the run names"
        ) from error


def _make_session(run: Run, config: TrainConfig, learner: Learner | None) -> Session:
    """Compile the functions of a session and make its environments. Without a learner, start with an untrained one."""
    task, n_seeds = run.config.task, len(run.seeds)
    env = make_jax_env(task) if config.env.is_jax else None
    if env is not None and config.batched:
        n_envs = config.n_envs * n_seeds // config.n_devices
        config = replace(config, resets_with_steps=is_reset_cheap(env, n_envs))
    iterates_on_host = env is None or config.has_first_fit
    functions = compile_ahead(config, run.graphs, n_seeds, iterates_on_host=iterates_on_host)
    loop = None if env is None else compile_loop(env, config, run.graphs, n_seeds)
    learner = learner or init_seeds(functions, seed_keys(jnp.asarray(run.seeds), 0))
    if env is not None:
        return Session(run, config, functions, learner, DeviceCollector(env, config, run.seeds), loop)
    collector = make_host_collector(task, config, run.seeds, run.config.settings.evaluation_episodes)
    session = Session(run, config, functions, learner, collector)
    if config.method.fit is not None:
        session.compile_while_collecting()
    return session


def _close(session: Session) -> None:
    """Close a session, and its worker processes."""
    try:
        session.close()
    finally:
        close_idle_workers()


def _finish(
    session: Session, tensorboard: bool, listeners: list[Listener], stop: threading.Event, messages: Sequence[str]
) -> Run:
    """Run a session to its end. Every listener that was started is stopped, also after an error."""
    run = session.run
    if tensorboard:
        listeners.append(TensorBoard(run.directory / EVENTS_DIRECTORY, session.step, run.seeds))
    with contextlib.ExitStack() as started:
        for listener in listeners:
            started.callback(listener.on_stop)
            for message in (*messages, *_introduction(session)):
                listener.on_message(message)
            name = f"{run.config.task.name} {session.settings.method}"
            listener.on_start(name, session.step, session.settings.steps)
        run_session(session, listeners, stop)
    return run


def _introduction(session: Session) -> list[str]:
    """Return messages about a session before its next step."""
    settings, warning = session.settings, warmup_warning(session.settings)
    if warning is None and session.step < settings.warmup:
        warning = f"the first {settings.warmup:,} steps are random ({settings.algorithm}.warmup): the policy is not trained yet"
    messages = [] if warning is None else [warning]
    if session.step >= settings.steps:
        messages.append(
            f"the run is complete ({settings.steps:,} steps): to continue it, give a larger --steps (steps=... in Python)"
        )
    return messages
