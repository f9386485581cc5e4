"""Training from start to end, and from a checkpoint to the end: Algorithm 1 of the LaRe paper around the fused step."""

import contextlib
import signal
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from lare.credit.methods import Encoder, find_method
from lare.errors import LareError
from lare.latent.design import design
from lare.latent.function import LatentFunction
from lare.tasks.spec import TaskSpec, load_task
from lare.training.progress import Clock, Listener, TensorBoard, Terminal
from lare.training.run import Run, create, default_directory, isolation, locked, open_run
from lare.training.session import Session, begin, load_learner, new_learner
from lare.training.settings import Settings


class Interrupted(LareError):
    """The user stopped a run. It was saved."""


def train(
    task: str | Path | TaskSpec,
    settings: Settings | None = None,
    *,
    function: LatentFunction | None = None,
    out: str | Path | None = None,
    tensorboard: bool = False,
    listeners: Sequence[Listener] | None = None,
) -> Run:
    """Train on a task's episodic rewards.

    Args:
        task: a shipped name, the path of a TOML file, or a spec.
        settings: method, algorithm, steps, seeds and all the rest.
        function: `phi`, for the methods that need one; without it, it is designed from the shipped recordings.
        out: the run directory, which must not exist; `runs/...` unless given.
        listeners: who is told of the progress; the terminal, unless given.

    Raises:
        LareError: something that was given cannot be used, or an environment or function failed. What was written until
            then is whole, and `resume` goes on from there.
    """
    task = task if isinstance(task, TaskSpec) else load_task(task)
    settings = settings or Settings()
    if find_method(settings.method).encoder is not Encoder.LATENT:
        function = None
    elif function is None:
        function = design(task, draw=settings.draw)
    run = create(Path(out) if out is not None else default_directory(task, settings), task, settings, function)
    with locked(run):
        return start(run, tensorboard, listeners)


def resume(directory: str | Path, *, tensorboard: bool = False, listeners: Sequence[Listener] | None = None) -> Run:
    """Go on with a run that was stopped or killed, from its last checkpoint to its end.

    On the CPU the metrics are then, bit for bit, those of a run that never stopped (but for the times).
    """
    run = open_run(directory)
    with locked(run):
        if not run.has_checkpoint():
            run.truncate(0)
            return start(run, tensorboard, listeners)
        _, learner, host, arrays = load_learner(run)
        run.truncate(host["metrics_length"])
        session = begin(run, lambda: learner)
        return finish(session, tensorboard, listeners, *session.return_to(host, arrays))


def start(run: Run, tensorboard: bool, listeners: Sequence[Listener] | None) -> Run:
    """From the first step on. The untrained learner is saved, so that there is a checkpoint whatever happens."""
    session = begin(run, partial(new_learner, run))
    session.save()
    return finish(session, tensorboard, listeners)


def finish(session: Session, tensorboard: bool, listeners: Sequence[Listener] | None, *messages: str) -> Run:
    """Run a session to its end, or until the user stops it."""
    run, settings = session.run, session.settings
    told: list[Listener] = [Terminal()] if listeners is None else list(listeners)
    if tensorboard:
        told.append(TensorBoard(run.directory / "tensorboard", session.step, run.seeds))
    for listener in told:
        for message in messages:
            listener.said(message)
        if run.function is not None:
            listener.said(f"the latent function runs in {isolation(run.config.task, run.function)}")
        listener.started(f"{run.config.task.name} {settings.method}", session.step, settings.steps)
    clock = Clock(session.step)
    try:
        with stop_requests() as stop:
            while session.step < settings.steps:
                session.advance()
                for listener in told:
                    listener.stepped(session.step)
                if session.step % settings.evaluate_every == 0 or session.step == settings.steps:
                    lines = session.report(clock.rate(session.step))
                    session.check_diverged(lines)
                    session.metrics_length = run.append(lines)
                    session.save()
                    for listener in told:
                        listener.evaluated(lines)
                if stop.is_set() and session.step < settings.steps:
                    session.save()
                    raise Interrupted(
                        f"stopped at step {session.step} and saved; go on with: lare train --resume {run.directory}"
                    )
    finally:
        for listener in told:
            listener.stopped()
        session.close()
    return run


@contextlib.contextmanager
def stop_requests() -> Iterator[threading.Event]:
    """An event that Ctrl-C or a polite kill sets, once; a second one ends the process at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may say what a signal does
        return

    def handle(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
