"""Training from the start or from a checkpoint to the end: the outer loop of Algorithm 1 of the LaRe paper."""

import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lare_rl.config.resolve import decide
from lare_rl.config.settings import ResolvedSettings, Settings, set_in_vain
from lare_rl.credit.closed_form import LARGEST_CHOICE
from lare_rl.credit.methods import Fit, Method, Reward, find_method
from lare_rl.envs.load import as_task
from lare_rl.errors import LareError, shortened
from lare_rl.latent.candidates import CANDIDATES
from lare_rl.latent.design import design
from lare_rl.latent.function import LatentFunction, check_task, per_role
from lare_rl.latent.improve import Model
from lare_rl.latent.saved import load
from lare_rl.runs.directory import Run, as_run, create, default_directory, locked
from lare_rl.tasks.spec import TaskSpec
from lare_rl.training import advice, first_fit
from lare_rl.training import session as sessions
from lare_rl.training.collect_host import Diverged
from lare_rl.training.explain import described
from lare_rl.training.process import enough_memory, stop_requests
from lare_rl.training.progress import Clock, Listener, TensorBoard, Terminal, summary_writer
from lare_rl.training.session import Session
from lare_rl.util import compilation

Given = LatentFunction | str | Path
"""A latent function, or the path of its file."""


EVENTS = "tensorboard"
"""The directory of TensorBoard events within the run directory."""


class Interrupted(LareError):
    """The user stopped a run. It was saved."""

    status = 130


def train(
    task: str | Path | TaskSpec,
    settings: Settings | None = None,
    *,
    function: Given | Sequence[Given] | None = None,
    model: Model | None = None,
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
        model: the model that `reflect_every` asks.
        out: the run directory, which must not exist; the default is `runs/...`.
        tensorboard: also write every number of metrics.jsonl as TensorBoard events, with the extra `lare-rl[tensorboard]`.
        listeners: objects that are told the progress; the default is the terminal.

    Raises:
        LareError: an argument cannot be used, or an environment or function failed. The files of the run are then still
            complete, and `resume` continues from the last checkpoint.
    """
    if tensorboard:
        summary_writer()  # before anything is made
    task = as_task(task)
    given = checked_settings(settings)
    told = told_by(listeners)
    resolved = decide(given, task)
    check_model(resolved, model)
    functions = chosen_functions(task, resolved, function)
    run = create(Path(out) if out is not None else default_directory(task, resolved), task, resolved, functions)
    in_vain = list(set_in_vain(given, resolved, task).values())
    said = in_vain[:1] if len(in_vain) < 2 else [f"{in_vain[0]} (and {len(in_vain) - 1} more)"]
    with locked(run), enough_memory(run), stop_requests() as stop:
        return begin(run, model, tensorboard, told, stop, *said)


def chosen_functions(
    task: TaskSpec, settings: ResolvedSettings, given: Given | Sequence[Given] | None
) -> tuple[LatentFunction, ...]:
    """One function for each role of the task, designed if none is given; empty for a method that needs none."""
    method = find_method(settings.method)
    if not method.latent:
        if given is not None:
            raise LareError(f"{method.name} needs no latent function, and one is given: leave it out")
        return ()
    if given is None:
        asked = partial(design, kind=method.kind, draw=settings.draw, candidates=settings.candidates)
        functions = [asked(role) for role in task.roles]
    else:
        check_given(settings)
        if not isinstance(given, Given | Sequence):
            raise LareError(
                "a latent function must be the path of its file, or come from lare_rl.design or lare_rl.load_function, and is "
                f"{shortened(given)}: write its source to a file, which is verified"
            )
        each = per_role([given] if isinstance(given, Given) else given, task)
        functions = [one if isinstance(one, LatentFunction) else load(one, role) for one, role in each]
        for function, role in zip(functions, task.roles, strict=True):
            check_task(function, role)
    for function in functions:
        check_size(method, function.size_by(settings.judged_by(task)))
    return tuple(functions)


def check_model(settings: ResolvedSettings, model: Model | None) -> None:
    """Raise `LareError` if a model is needed and not given, or given and not needed."""
    if settings.reflect_every is not None and model is None:
        raise LareError("reflect_every asks a language model: say which one with --model NAME (model=... in Python)")
    if settings.reflect_every is None and model is not None:
        raise LareError("a model is given, and nothing asks it: say how often with --reflect-every STEPS")


def check_given(settings: ResolvedSettings) -> None:
    """Raise `LareError` if a recorded function is chosen although another one is given."""
    if (settings.draw, settings.candidates) != (0, CANDIDATES):
        raise LareError("draw and candidates choose a recorded function, and a function is given: leave either out")


def check_size(method: Method, factors: int) -> None:
    """Raise `LareError` if a method cannot use so many factors."""
    if method.reward is Reward.DESIGNED and factors != 1:
        raise LareError(
            f"{method.name} needs a function with one array, the reward, and this one has {factors}: "
            "lare-rl design TASK --kind reward writes one"
        )
    if method.fit is Fit.SIGNS and factors > LARGEST_CHOICE:
        raise LareError(f"{method.name} tries all signs of at most {LARGEST_CHOICE} factors, and there are {factors}")


def resume(
    directory: Run | str | Path,
    *,
    steps: int | None = None,
    model: Model | None = None,
    tensorboard: bool = False,
    listeners: Sequence[Listener] | None = None,
) -> Run:
    """Continue a run that was stopped or killed, from its last checkpoint to its end; or extend it.

    On the CPU, the metrics are the same, bit for bit, as those of a run that was never stopped (except the times).

    Args:
        directory: the run, or its directory.
        steps: a new number of environment steps of each seed, to extend the run. Schedules over the whole run (`ppo.anneal`)
            then go by the new number.
        model: the model that `reflect_every` asks.
        tensorboard: also write TensorBoard events. A run that has some always continues them.
        listeners: objects that are told the progress; the default is the terminal.

    Raises:
        LareError: it is not a run, its checkpoint does not exist any more, or `steps` is smaller than before; and as in `train`.
    """
    run, told = as_run(directory), told_by(listeners)
    tensorboard = tensorboard or (run.directory / EVENTS).is_dir()
    if tensorboard:
        summary_writer()
    check_model(run.config.settings, model)
    with locked(run), enough_memory(run), stop_requests() as stop:
        run = run if steps is None else run.extended(steps)
        if not run.has_checkpoint():
            if run.metrics():  # metrics are never removed
                raise LareError(f"{run.directory} has no checkpoint any more: it cannot be resumed")
            return begin(run, model, tensorboard, told, stop)
        prepare(run, told)
        restored, messages = sessions.restore(run)
        run.truncate(restored.metrics_length)
        return finish(restored, model, tensorboard, told, stop, *messages)


def told_by(listeners: Sequence[Listener] | None) -> list[Listener]:
    """The given listeners, or the terminal. Raises `LareError` if an object is not a listener."""
    told: list[Listener] = [Terminal()] if listeners is None else list(listeners)
    for one in told:
        if not isinstance(one, Listener):
            raise LareError(
                "a listener must have the methods started, stepped, evaluated, said and stopped "
                f"(lare_rl.training.progress.Listener): {shortened(one)} does not"
            )
    return told


def checked_settings(given: Settings | None) -> Settings:
    """The given settings, or the default ones. Raises `LareError` if they are something else."""
    if given is None or isinstance(given, Settings):
        return given or Settings()
    raise LareError(
        f"settings must be a lare_rl.Settings, such as lare_rl.Settings(method='rrdu', steps=100_000), and are {shortened(given)}"
    )


def prepare(run: Run, told: Sequence[Listener]) -> None:
    """Turn on the compilation cache, and tell the listeners how long compiling takes."""
    for listener in told:
        listener.said(
            f"preparing {run.directory}: compiling takes about half a minute, or about ten seconds if it was done before"
        )
    compilation.keep()


def begin(
    run: Run, model: Model | None, tensorboard: bool, told: list[Listener], stop: threading.Event, *messages: str
) -> Run:
    """Train from the first step on. The untrained learner is saved, so that there is always a checkpoint."""
    prepare(run, told)
    started = sessions.start(run)
    started.save()
    return finish(started, model, tensorboard, told, stop, *messages)


def finish(
    session: Session,
    model: Model | None,
    tensorboard: bool,
    told: list[Listener],
    stop: threading.Event,
    *messages: str,
) -> Run:
    """Run a session to its end, or until `stop` is set."""
    run, settings = session.run, session.settings
    clock, explained = Clock(session.step), False
    returns: list[np.ndarray] = []

    def say(*lines: str) -> None:
        for line in lines:
            for listener in told:
                listener.said(line)

    try:
        if tensorboard:
            told.append(TensorBoard(run.directory / EVENTS, session.step, run.seeds))
        for listener in told:
            introduce(session, listener, messages)
        while session.step < settings.steps:
            advance(session, stop)
            for listener in told:
                listener.stepped(session.step)
            if session.step - settings.iteration_steps <= settings.warmup < session.step:
                say(*advice.of_observations(run, session.learner.replay, session.config))
            last = session.step == settings.steps
            if last or session.step % settings.evaluate_every == 0:
                lines = evaluate(session, clock.rate(session.step))
                for listener in told:
                    listener.evaluated(lines)
                if "critic/loss" in lines[0]:
                    returns.append(np.array([line["evaluation/return"] for line in lines]))
                    say(*advice.of_returns(returns))
                if last or not explained:
                    sentences = explanation(session)
                    say(*sentences)
                    explained = bool(sentences)
                if last and advice.SATURATION in lines[0]:
                    say(*advice.of_saturation([line[advice.SATURATION] for line in lines], run.seeds))
                if last and not settings.untrained and (why := run.untrained):
                    say(why)
            if model is not None and due(session.step, settings.reflect_every, settings.steps):
                session.reflect(model, say)
    finally:
        for listener in told:
            listener.stopped()
        session.close()
    return session.run


def advance(session: Session, stop: threading.Event) -> None:
    """One iteration. Raises `Interrupted` if the user has asked the run to stop; the run is then saved."""
    directory = session.run.directory
    if stop.is_set():
        check_losses(session)
        session.save()
        raise Interrupted(
            f"stopped at step {session.step} of {session.settings.steps} and saved; to continue: lare-rl train --resume {directory}"
        )
    try:
        session.advance(stop.is_set)
    except first_fit.Stopped:
        raise Interrupted(
            f"stopped during the decoder's first fit; to continue: lare-rl train --resume {directory}"
        ) from None


def evaluate(session: Session, rate: float) -> list[dict[str, Any]]:
    """Evaluate, and write the metrics and a checkpoint; returns the lines of metrics.jsonl."""
    lines = session.report(rate)
    check_losses(session)
    session.metrics_length = session.run.append(lines)
    session.save()
    return lines


def due(step: int, every: int | None, last: int) -> bool:
    """Whether something that is done every so many steps is due; never at the last step."""
    return every is not None and step % every == 0 and step < last


def explanation(session: Session) -> list[str]:
    """How well returns can be explained, in sentences; empty before the first updates and while there are too few episodes."""
    if session.step < session.settings.warmup:
        return []
    return described(session.run, session.learner, session.config)


def introduce(session: Session, listener: Listener, messages: Sequence[str]) -> None:
    """Tell a listener about a session before its next step."""
    run, settings = session.run, session.settings
    for message in messages:
        listener.said(message)
    if settings.untrained:
        listener.said(settings.untrained)
    elif session.step < settings.warmup:
        listener.said(
            f"the first {settings.warmup:,} steps are random ({settings.algorithm}.warmup): the policy is not trained yet"
        )
    if session.step >= settings.steps:
        listener.said(
            f"nothing is left to do: it has made its {settings.steps:,} steps; more --steps (steps=... in Python) make it longer"
        )
    listener.started(f"{run.config.task.name} {settings.method}", session.step, settings.steps)


def check_losses(session: Session) -> None:
    """Raise `Diverged` if a loss is not finite, so that the useless state is not saved."""
    updates = np.asarray(session.latest.get("algorithm/updates", np.ones(len(session.run.seeds))))
    losses = (name for name in session.latest if name.startswith(("critic/loss", "credit/loss")))
    for name in losses:
        for seed, value, made in zip(session.run.seeds, np.asarray(session.latest[name]), updates, strict=True):
            if made and not np.isfinite(value):
                raise Diverged(
                    f"training diverged: {name} of seed {seed} is not finite at step {session.step}; "
                    "the last checkpoint is whole"
                )
