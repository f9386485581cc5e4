"""Trains a run from its start, or from its last checkpoint, to its end: iterations, evaluations, checkpoints, messages."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.config.effective import describe_unused_settings, warmup_warning
from lare_rl.config.resolve import resolve
from lare_rl.config.settings import ResolvedSettings, Settings
from lare_rl.envs.load import resolve_task
from lare_rl.errors import LareError, short_repr
from lare_rl.runs.config_file import read_config, write_config
from lare_rl.runs.directory import Run, as_run, create_run, default_directory, extend_run, lock_run
from lare_rl.runs.metric_names import ACTOR_SATURATION, RETURN, was_updated
from lare_rl.runs.metrics_file import append_metrics, truncate_metrics
from lare_rl.tasks.spec import TaskSpec
from lare_rl.tasks.trust import command_line
from lare_rl.training import advice
from lare_rl.training.decoder_fits import FirstFitStoppedError
from lare_rl.training.explain import describe_returns
from lare_rl.training.latent_functions import FunctionOrPath, choose_functions
from lare_rl.training.process import catch_stop_signals, report_full_memory
from lare_rl.training.progress import Listener, TensorBoard, Terminal, import_summary_writer
from lare_rl.training.seed_axis import first_device_seeds
from lare_rl.training.session import Session, restore_session, start_session
from lare_rl.util import compilation
from lare_rl.util.findings import Finding, render
from lare_rl.util.float64 import require_float32

__all__ = ["RunInterruptedError", "resume", "run_session", "train"]

EVENTS_DIRECTORY = "tensorboard"
"""The folder of TensorBoard events in a run's directory."""
CHECKPOINT_S = 300.0
"""Between two evaluations, a checkpoint is written after so many seconds. A crash loses at most about this much work."""
PROGRESS_S = 1.0
"""The least time (s) between two calls of `on_step` inside an iteration."""


class RunInterruptedError(LareError):
    """The user stopped a run, which can be continued from its last checkpoint."""

    status = 130


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
        LareError: an argument cannot be used, and no run is created; or an environment or function failed: the files of the run are
            then complete, and `resume` continues from the last checkpoint.
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
    unused = list(describe_unused_settings(settings, resolved, task).values())
    messages = unused[:1] if len(unused) < 2 else [f"{unused[0]} (and {len(unused) - 1} more)"]
    messages += _describe_rounding(resolved, steps=settings.steps, evaluate_every=settings.evaluate_every)
    with lock_run(run), report_full_memory(run), catch_stop_signals() as stop:
        return _run_to_end(run, tensorboard, listeners, stop, messages, resolved.steps)


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
        return _run_to_end(run, tensorboard, listeners, stop, messages, earlier_steps)


def _describe_rounding(resolved: ResolvedSettings, **requested: int | None) -> list[str]:
    """Return a message about each number of steps that was rounded up to whole iterations."""
    iteration = f"an iteration has {resolved.iteration_steps:,} steps (environments x rollout_steps)"
    return [
        f"{name} = {steps:,} is rounded up to {rounded:,}: {iteration}"
        for name, steps in requested.items()
        if steps is not None and (rounded := getattr(resolved, name)) != steps
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


def _run_to_end(
    run: Run,
    tensorboard: bool,
    listeners: Sequence[Listener],
    stop: threading.Event,
    messages: Sequence[str],
    earlier_steps: int,
) -> Run:
    """Run to the end, from the last checkpoint if there is one. Every listener that was started is stopped, also after an error.

    `messages` are sent to the listeners before training starts. A run that is extended had `earlier_steps` before.
    """
    for listener in listeners:
        listener.on_message(
            f"preparing {run.directory}: compiling takes about half a minute, or about ten seconds if it was done before"
        )
    require_float32()
    compilation.enable_cache()
    is_new = not run.has_checkpoint()
    session, restore_messages = (start_session(run), []) if is_new else restore_session(run)
    with contextlib.ExitStack() as opened:
        opened.callback(session.close)
        if is_new:
            session.save()  # so that there is always a checkpoint
        else:
            truncate_metrics(run.directory, session.metrics_bytes)
        if run.config.settings.steps != earlier_steps:
            write_config(run.directory, run.config)  # the run could be restored
        if tensorboard:
            listeners = [*listeners, TensorBoard(run.directory / EVENTS_DIRECTORY, session.step, run.seeds)]
        messages = [*messages, *restore_messages, *_introduction(session, earlier_steps)]
        name = f"{run.config.task.name} {session.settings.method}"
        for listener in listeners:
            opened.callback(listener.on_stop)
            for message in messages:
                listener.on_message(message)
            listener.on_start(name, session.step, session.settings.steps)
        run_session(session, listeners, stop)
    return run


def _introduction(session: Session, earlier_steps: int) -> list[str]:
    """Return what the user should know of a session before its next step."""
    settings, step, messages = session.settings, session.step, []
    if step and settings.steps > earlier_steps and getattr(settings.hyperparameters, "anneal", False):
        messages.append(
            f"{settings.algorithm}.anneal: the learning rate had fallen to {max(0, 1 - step / earlier_steps):.0%} of its initial value, "
            f"and falls again from {1 - step / settings.steps:.0%}, so the result is not that of one long run; a run that began with "
            f"--{settings.algorithm}.no-anneal can be extended without this difference"
        )
    if (warning := warmup_warning(settings)) is not None:
        messages.append(warning)
    elif step < settings.warmup:
        messages.append(
            f"the first {settings.warmup:,} steps are random ({settings.algorithm}.warmup): the policy is not trained yet"
        )
    if step >= settings.steps:
        messages.append(
            f"the run is complete ({settings.steps:,} steps): to continue it, give a larger --steps (steps=... in Python)"
        )
    return messages


def run_session(session: Session, listeners: Sequence[Listener], stop: threading.Event) -> None:
    """Make iterations, evaluations and checkpoints to the end of a run: the outer loop of Algorithm 1 of the LaRe paper.

    Raises:
        RunInterruptedError: `stop` was set.
        DivergedError: a policy or a loss is not finite any more.
    """
    run, settings = session.run, session.settings
    is_explained, saved_at = False, time.monotonic()
    rated_step, rated_at = session.step, saved_at  # when the last rate was measured
    returns: list[np.ndarray] = []
    evaluated_at: list[float] = []
    session.watch(_limit_rate(lambda step: [listener.on_step(step) for listener in listeners]), stop.is_set)

    def say(lines: Iterable[str]) -> None:
        for line in lines:
            for listener in listeners:
                listener.on_message(line)

    def report(findings: Iterable[Finding]) -> None:
        say(render(finding, advice.MESSAGES) for finding in findings)

    report(advice.find_unwritten_texts(run.config.task) if session.step == 0 else [])
    while session.step < settings.steps:
        before = session.step
        _advance(session, stop)
        for listener in listeners:
            listener.on_step(session.step)
        if before <= settings.warmup < session.step:
            report(advice.find_large_observations(run, first_device_seeds(session.learner.replay), session.config))
        is_last = session.step == settings.steps
        if not is_last and session.step % settings.evaluate_every:
            if time.monotonic() - saved_at > CHECKPOINT_S:
                session.save()
                saved_at = time.monotonic()
            continue
        began_at = time.monotonic()
        rate = (session.step - rated_step) / max(began_at - rated_at, 1e-9)
        rated_step, rated_at = session.step, began_at
        lines = session.evaluate(rate)
        evaluation_s = time.monotonic() - began_at
        session.metrics_bytes = append_metrics(run.directory, lines)
        session.save()
        saved_at = time.monotonic()
        evaluated_at.append(saved_at)
        for listener in listeners:
            listener.on_evaluation(lines)
        if any(map(was_updated, lines)):
            returns.append(np.array([line[RETURN] for line in lines], float))
            report(advice.find_constant_returns(returns))
        if len(evaluated_at) == 2:  # the first one compiles the policy
            report(advice.find_slow_evaluations(settings, evaluation_s, saved_at - evaluated_at[0]))
        if session.step >= settings.warmup and (is_last or not is_explained):
            sentences = describe_returns(run, session.learner, session.config, legend=not is_explained)
            report([Finding("provisional")] if sentences and not is_last else [])
            say(sentences)
            is_explained = bool(sentences)
        if is_last:
            report(_final_findings(run, lines))


def _advance(session: Session, stop: threading.Event) -> None:
    """Advance a session, at most to its next evaluation. Raise `RunInterruptedError` if `stop` is set."""
    step, settings = session.step, session.settings
    run = session.run
    hint = f"to continue: {command_line(run.config.task, 'train', '--resume', run.directory)}"
    if stop.is_set():
        session.save()
        session.finish_saving()
        raise RunInterruptedError(f"stopped at step {step} of {settings.steps} and saved; {hint}")
    try:
        session.advance(min(settings.steps, (step // settings.evaluate_every + 1) * settings.evaluate_every))
    except FirstFitStoppedError:
        raise RunInterruptedError(f"stopped during the decoder's first fit: nothing is kept of it; {hint}") from None


def _limit_rate(call: Callable[[int], object]) -> Callable[[int], None]:
    """Return a function that passes on at most one call in `PROGRESS_S` seconds."""
    called_at = time.monotonic()

    def call_rarely(step: int) -> None:
        nonlocal called_at
        if time.monotonic() - called_at > PROGRESS_S:
            called_at = time.monotonic()
            call(step)

    return call_rarely


def _final_findings(run: Run, lines: Sequence[dict[str, Any]]) -> list[Finding]:
    findings = advice.find_equal_returns(run)
    if ACTOR_SATURATION in lines[0]:
        findings = advice.find_saturated_policies([line[ACTOR_SATURATION] for line in lines], run.seeds) + findings
    untrained = advice.find_untrained(run)
    if untrained is not None and untrained.code != "all steps random":  # `_introduction` has said so
        findings.append(untrained)
    return findings
