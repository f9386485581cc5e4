"""The outer loop of Algorithm 1 of the LaRe paper: iterations, evaluations, checkpoints, and messages for the user."""

import shlex
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from lare_rl.errors import LareError
from lare_rl.runs.directory import Run
from lare_rl.runs.metric_names import ACTOR_SATURATION, RETURN, was_updated
from lare_rl.runs.metrics_file import append_metrics
from lare_rl.training import advice
from lare_rl.training.decoder_fits import FirstFitStoppedError
from lare_rl.training.explain import describe_returns
from lare_rl.training.progress import Listener
from lare_rl.training.seed_axis import first_shard
from lare_rl.training.session import Session
from lare_rl.training.unroll_host import DivergedError
from lare_rl.util.findings import Finding, render

__all__ = ["RunInterruptedError", "run_session"]

CHECKPOINT_S = 300.0
"""Seconds after which a checkpoint is written between two evaluations: what a crash may cost."""
PROGRESS_S = 1.0
"""Listeners hear of steps inside an iteration at most this often (s)."""


class RunInterruptedError(LareError):
    """The user stopped a run, which can be continued from its last checkpoint."""

    status = 130


def run_session(session: Session, listeners: Sequence[Listener], stop: threading.Event) -> None:
    """Run a session to its end.

    Raises:
        RunInterruptedError: `stop` was set.
        DivergedError: a policy or a loss is not finite any more.
    """
    run, settings = session.run, session.settings
    explained, saved_at = False, time.monotonic()
    rated_step, rated_at = session.step, saved_at
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
        _advance(session, min(settings.steps, (before // settings.evaluate_every + 1) * settings.evaluate_every), stop)
        for listener in listeners:
            listener.on_step(session.step)
        if before <= settings.warmup < session.step:
            report(advice.find_large_observations(run, first_shard(session.learner.replay), session.config))
        is_last = session.step == settings.steps
        if not is_last and session.step % settings.evaluate_every:
            if time.monotonic() - saved_at > CHECKPOINT_S:
                _save(session)
                saved_at = time.monotonic()
            continue
        began_at = time.monotonic()
        rate = (session.step - rated_step) / max(began_at - rated_at, 1e-9)
        rated_step, rated_at = session.step, began_at
        lines = session.evaluate(rate)
        evaluation_s = time.monotonic() - began_at
        _check_losses(session)
        session.metrics_bytes = append_metrics(run.directory, lines)
        session.save()
        saved_at = time.monotonic()
        evaluated_at.append(saved_at)
        for listener in listeners:
            listener.on_evaluation(lines)
        if any(map(was_updated, lines)):
            returns.append(np.array([line[RETURN] for line in lines]))
            report(advice.find_constant_returns(returns))
        if len(evaluated_at) == 2:  # the first one compiles the policy
            report(advice.find_slow_evaluations(settings, evaluation_s, saved_at - evaluated_at[0]))
        if session.step >= settings.warmup and (is_last or not explained):
            sentences = describe_returns(run, session.learner, session.config, legend=not explained)
            report([Finding("provisional")] if sentences and not is_last else [])
            say(sentences)
            explained = bool(sentences)
        if is_last:
            report(_final_findings(run, lines))


def _limit_rate(call: Callable[[int], object]) -> Callable[[int], None]:
    """Return a function that passes on at most one call in `PROGRESS_S`."""
    called_at = time.monotonic()

    def call_rarely(step: int) -> None:
        nonlocal called_at
        if time.monotonic() - called_at > PROGRESS_S:
            called_at = time.monotonic()
            call(step)

    return call_rarely


def _advance(session: Session, until: int, stop: threading.Event) -> None:
    """Make iterations, none beyond step `until`, unless the user has asked the run to stop."""
    hint = f"to continue: lare-rl train --resume {shlex.quote(str(session.run.directory))}"
    if stop.is_set():
        _save(session)
        session.finish_saving()
        raise RunInterruptedError(f"stopped at step {session.step} of {session.settings.steps} and saved; {hint}")
    try:
        session.advance(until)
    except FirstFitStoppedError:
        raise RunInterruptedError(f"stopped during the decoder's first fit: nothing is kept of it; {hint}") from None


def _save(session: Session) -> None:
    _check_losses(session)
    session.save()


def _final_findings(run: Run, lines: Sequence[dict[str, Any]]) -> list[Finding]:
    findings = advice.find_equal_returns(run)
    if ACTOR_SATURATION in lines[0]:
        findings = advice.find_saturated_policies([line[ACTOR_SATURATION] for line in lines], run.seeds) + findings
    untrained = advice.find_untrained(run)
    if untrained is not None and untrained.code != "all steps random":  # that was the first message
        findings.append(untrained)
    return findings


def _check_losses(session: Session) -> None:
    """Raise `DivergedError` if a loss is not finite, so that the useless state is not saved."""
    seeds, metrics = session.run.seeds, session.latest_metrics
    updates = np.asarray(metrics.get("algorithm/updates", np.ones(len(seeds))))
    for name in metrics:
        if not name.startswith(("critic/loss", "credit/loss")):
            continue
        for seed, loss, n_updates in zip(seeds, np.asarray(metrics[name]), updates, strict=True):
            if n_updates and not np.isfinite(loss):
                raise DivergedError(
                    f"training diverged: {name} of seed {seed} is not finite at step {session.step}; the last checkpoint is "
                    "whole: train again with a smaller learning rate (a JaxEnv may also have returned NaN)"
                )
