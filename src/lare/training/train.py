"""Training from start to end, and from a checkpoint to the end: Algorithm 1 of the LaRe paper around the fused step."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lare import compilation
from lare.credit.closed_form import LARGEST_CHOICE
from lare.credit.methods import Fit, Method, Reward, find_method
from lare.errors import LareError, shortened
from lare.latent.candidates import CANDIDATES
from lare.latent.design import design
from lare.latent.function import LatentFunction, check_task, load, per_role
from lare.latent.improve import Model
from lare.run.decide import decide
from lare.run.directory import Run, as_run, create, default_directory, isolation, locked
from lare.run.settings import ResolvedSettings, Settings, set_in_vain
from lare.tasks.spec import TaskSpec, as_task
from lare.training import session as sessions
from lare.training.collect_host import Diverged
from lare.training.explain import described
from lare.training.process import enough_memory, stop_requests
from lare.training.progress import Clock, Listener, TensorBoard, Terminal, summary_writer
from lare.training.session import Session

Given = LatentFunction | str | Path
"""A latent function, or the path of its file."""


EVENTS = "tensorboard"
"""Where the run directory has them."""


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
        function: `phi`, or the path of its file, for the methods that need one; one for each team where several learn. Without
            it, it is designed from the shipped recordings.
        model: whom `reflect_every` asks.
        out: the run directory, which must not exist; `runs/...` unless given.
        tensorboard: also write every number of metrics.jsonl as TensorBoard events, with the extra `lare-rl[tensorboard]`.
        listeners: who is told of the progress; the terminal, unless given.

    Raises:
        LareError: something that was given cannot be used, or an environment or function failed. What was written until
            then is whole, and `resume` goes on from there.
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
    with locked(run), enough_memory(run):
        return begin(run, model, tensorboard, told, *said)


def chosen_functions(
    task: TaskSpec, settings: ResolvedSettings, given: Given | Sequence[Given] | None
) -> tuple[LatentFunction, ...]:
    """One for each role of the task, designed where none was given; none for a method that needs none."""
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
                "a latent function is the path of its file, or what lare.design and lare.load_function give; it is "
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
    """Raise `LareError` where a model is needed and not given, or given and not needed."""
    if settings.reflect_every is not None and model is None:
        raise LareError("reflect_every asks a language model: say which one with --model NAME (model=... in Python)")
    if settings.reflect_every is None and model is not None:
        raise LareError("a model is given, and nothing asks it: say how often with --reflect-every STEPS")


def check_given(settings: ResolvedSettings) -> None:
    """Raise `LareError` where a recorded function is chosen although another one is given."""
    if (settings.draw, settings.candidates) != (0, CANDIDATES):
        raise LareError("draw and candidates choose a recorded function, and a function is given: leave either out")


def check_size(method: Method, factors: int) -> None:
    """Raise `LareError` where a method can do nothing with so many factors."""
    if method.reward is Reward.DESIGNED and factors != 1:
        raise LareError(
            f"{method.name} needs a function with one array, the reward, and this one has {factors}: "
            "lare design TASK --kind reward writes one"
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
    """Go on with a run that was stopped or killed, from its last checkpoint to its end; or beyond it.

    On the CPU the metrics are then, bit for bit, those of a run that never stopped (but for the times).

    Args:
        directory: of the run, or the run.
        steps: environment steps of each seed that the run is to have made at its end, where that is more than was asked for at
            first. What falls over the whole run (`ppo.anneal`) falls over the longer one from now on.
        model: whom `reflect_every` asks.
        tensorboard: also write TensorBoard events. They go on by themselves where the run has some.
        listeners: who is told of the progress; the terminal, unless given.

    Raises:
        LareError: it is not a run, or its checkpoint is not there any more, or `steps` are fewer; and as `train`.
    """
    run, told = as_run(directory), told_by(listeners)
    tensorboard = tensorboard or (run.directory / EVENTS).is_dir()
    if tensorboard:
        summary_writer()
    check_model(run.config.settings, model)
    with locked(run), enough_memory(run):
        run = run if steps is None else run.extended(steps)
        if not run.has_checkpoint():
            if run.metrics():  # what has been measured is never taken back
                raise LareError(f"{run.directory} has no checkpoint any more: there is nothing to go on from")
            return begin(run, model, tensorboard, told)
        prepare(run, told)
        restored, messages = sessions.restore(run)
        run.truncate(restored.metrics_length)
        return finish(restored, model, tensorboard, told, *messages)


def told_by(listeners: Sequence[Listener] | None) -> list[Listener]:
    """The listeners that were given, or the terminal. Raises `LareError` where one cannot listen."""
    told: list[Listener] = [Terminal()] if listeners is None else list(listeners)
    for one in told:
        if not isinstance(one, Listener):
            raise LareError(
                f"a listener has the methods started, stepped, evaluated, said and stopped (lare.training.progress.Listener): "
                f"{shortened(one)} has not"
            )
    return told


def checked_settings(given: Settings | None) -> Settings:
    """The settings, or the usual ones. Raises `LareError` where they are something else."""
    if given is None or isinstance(given, Settings):
        return given or Settings()
    raise LareError(
        f"settings are a lare.Settings, as lare.Settings(method='rrdu', steps=100_000); they are {shortened(given)}"
    )


def prepare(run: Run, told: Sequence[Listener]) -> None:
    """What comes before the first compilation, and a word on how long it takes."""
    for listener in told:
        listener.said(
            f"preparing {run.directory}: compiling takes about half a minute, or some ten seconds where it was done before"
        )
    compilation.keep()


def begin(run: Run, model: Model | None, tensorboard: bool, told: list[Listener], *messages: str) -> Run:
    """From the first step on. The untrained learner is saved, so that there is a checkpoint whatever happens."""
    prepare(run, told)
    started = sessions.start(run)
    started.save()
    return finish(started, model, tensorboard, told, *messages)


def finish(
    session: Session,
    model: Model | None,
    tensorboard: bool,
    told: list[Listener],
    *messages: str,
) -> Run:
    """Run a session to its end, or until the user stops it."""
    run, settings = session.run, session.settings
    clock, explained = Clock(session.step), False

    def say(line: str) -> None:
        for listener in told:
            listener.said(line)

    try:
        if tensorboard:
            told.append(TensorBoard(run.directory / EVENTS, session.step, run.seeds))
        for listener in told:
            introduce(session, listener, messages)
        with stop_requests() as stop:
            while session.step < settings.steps:
                session.advance()
                for listener in told:
                    listener.stepped(session.step)
                if session.step % settings.evaluate_every == 0 or session.step == settings.steps:
                    lines = session.report(clock.rate(session.step))
                    check_losses(session)
                    session.metrics_length = run.append(lines)
                    session.save()
                    for listener in told:
                        listener.evaluated(lines)
                    if session.step == settings.steps or not explained:
                        sentences = explanation(session)
                        for line in sentences:
                            say(line)
                        explained = explained or bool(sentences)
                if model is not None and due(session.step, settings.reflect_every, settings.steps):
                    session.reflect(model, say)
                if stop.is_set() and session.step < settings.steps:
                    check_losses(session)
                    session.save()
                    raise Interrupted(
                        f"stopped at step {session.step} and saved; go on with: lare train --resume {run.directory}"
                    )
    finally:
        for listener in told:
            listener.stopped()
        session.close()
    return session.run


def due(step: int, every: int | None, last: int) -> bool:
    """Whether it is the turn of what comes again and again, but not at the end."""
    return every is not None and step % every == 0 and step < last


def explanation(session: Session) -> list[str]:
    """How well returns can be told, in words; nothing before the first updates and as long as there are few episodes."""
    if session.step < session.settings.warmup:
        return []
    return described(session.run, session.learner, session.config)


def introduce(session: Session, listener: Listener, messages: Sequence[str]) -> None:
    """What is to be said of a session before its next step."""
    run, settings = session.run, session.settings
    for message in messages:
        listener.said(message)
    if run.function is not None:
        listener.said(f"the latent function runs in {isolation(run.config.task, run.function)}")
    if session.step < settings.warmup:
        which = f"the first {settings.warmup:,}" if settings.warmup < settings.steps else f"all {settings.steps:,}"
        listener.said(f"{which} steps are random ({settings.algorithm}.warmup): the policy is not trained yet")
    if session.step >= settings.steps:
        listener.said(
            f"nothing is left to do: it has made its {settings.steps:,} steps; more --steps (steps=... in Python) make it longer"
        )
    listener.started(f"{run.config.task.name} {settings.method}", session.step, settings.steps)


def check_losses(session: Session) -> None:
    """Raise `Diverged` where a loss is not finite: what is saved then is of no use."""
    updates = np.asarray(session.latest.get("algorithm/updates", np.ones(len(session.run.seeds))))
    losses = (name for name in session.latest if name.startswith(("critic/loss", "credit/loss")))
    for name in losses:
        for seed, value, made in zip(session.run.seeds, np.asarray(session.latest[name]), updates, strict=True):
            if made and not np.isfinite(value):
                raise Diverged(
                    f"training diverged: {name} of seed {seed} is not finite at step {session.step}; "
                    "the last checkpoint is whole"
                )
