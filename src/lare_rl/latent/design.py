"""Candidates, combine, verify, correct: lines 2 and 3 of Algorithm 1 of the LaRe paper."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lare_rl.envs.load import as_task
from lare_rl.errors import LareError, shortened
from lare_rl.latent.candidates import CANDIDATES, MOST_CANDIDATES
from lare_rl.latent.function import LatentFunction, normal, of_verdict
from lare_rl.latent.verify import Check, Steps, Verdict, sample_steps, verify
from lare_rl.llm import prompts
from lare_rl.llm.model import Model, recorded_model
from lare_rl.llm.prompts import Kind, Message, Stage
from lare_rl.llm.recording import Recorder
from lare_rl.llm.reply import MalformedReply, parse
from lare_rl.tasks.spec import TaskSpec, the_role

ATTEMPTS = 5
"""How often a function is verified, the first time included, before the loop gives up."""

LONGEST_QUOTE = 20_000
"""Characters of a failed reply that are shown to the model again."""


class DesignFailed(LareError):
    """No attempt passed. `recorder` holds all exchanges with the model."""

    status = 1

    def __init__(self, message: str, recorder: Recorder, model: str):
        super().__init__(message)
        self.recorder, self.model = recorder, model


class DesignBroken(DesignFailed):
    """The model became unavailable before an attempt passed."""

    status = 2


class DesignStopped(DesignFailed):
    """The user stopped the design before an attempt passed."""

    status = 130


@dataclass(frozen=True)
class Attempt:
    """A reply, and the result of its verification."""

    reply: str
    source: str
    """Empty if the reply could not be read."""
    verdict: Verdict
    errors: str
    """All errors of the reply, for the model; empty if it passed."""


def examine(reply: str, task: TaskSpec, kind: Kind, steps: Steps | None = None) -> Attempt:
    """Read and verify a reply."""
    try:
        source = normal(parse(reply).functions)
    except MalformedReply as error:
        return Attempt(reply, "", Verdict(()), str(error))
    verdict = verify(source, task, kind, steps)
    return Attempt(reply, source, verdict, verdict.errors)


def first_line(attempt: Attempt) -> str:
    """The first error of an attempt, in one line."""
    lines = attempt.errors.splitlines() or ["passes"]
    return lines[0] + (f" (and {len(lines) - 1} more)" if len(lines) > 1 else "")


@dataclass(frozen=True)
class Conversation:
    """A model, and the requests to it about a task. Every reply is recorded."""

    task: TaskSpec
    kind: Kind
    model: Model
    recorder: Recorder
    said: Callable[[str], None]
    steps: Steps | None = None
    """The steps that functions are tried on. None means random steps of the environment."""

    def ask(self, stage: Stage, messages: Sequence[Message]) -> str:
        """A reply to a request. Each call asks for a new reply."""
        reply = self.model.reply(messages, self.recorder.asked(stage, messages))
        self.recorder.take(stage, messages, reply, self.model.name)
        return reply

    def begin(self, candidates: int, pre_verification: bool) -> tuple[list[Message], str]:
        """Ask for candidates and their combination. Returns the last request and the reply to it.

        Only candidates that pass verification are combined. If none passes, or without pre-verification, all are combined.
        """
        request = prompts.candidate(self.task, self.kind)
        replies = [self.ask("candidate", request) for _ in range(candidates)]
        if candidates == 1:
            return request, replies[0]
        sound = self.sound(replies) if pre_verification else []
        request = prompts.combine(self.task, sound or [quoted(reply) for reply in replies], self.kind)
        return request, self.ask("combine", request)

    def sound(self, replies: Sequence[str]) -> list[str]:
        """The replies that can be read and pass verification."""
        tried = [examine(reply, self.task, self.kind, self.steps) for reply in replies]
        for number, attempt in enumerate(tried, start=1):
            self.said(f"candidate {number}: {first_line(attempt)}")
        return [attempt.reply for attempt in tried if not attempt.errors]

    def correct(self, request: list[Message], reply: str) -> Attempt:
        """Verify a reply, and ask for corrections until one passes. Raises `DesignFailed` after the last attempt."""
        attempt = examine(reply, self.task, self.kind, self.steps)
        for number in range(2, ATTEMPTS + 1):
            self.said(f"attempt {number - 1}: {first_line(attempt)}")
            if not attempt.errors:
                return attempt
            request = prompts.correct(request, quoted(attempt.reply), attempt.errors)
            attempt = examine(self.ask("correct", request), self.task, self.kind, self.steps)
        self.said(f"attempt {ATTEMPTS}: {first_line(attempt)}")
        if not attempt.errors:
            return attempt
        raise self.failed(f"none of {ATTEMPTS} attempts passed; the last one failed: {first_line(attempt)}")

    def once(self, reply: str) -> Attempt:
        """Accept a reply if it can be read: the ablation without pre-verification. Raises `DesignFailed` if it cannot."""
        attempt = examine(reply, self.task, self.kind, self.steps)
        if attempt.verdict.graph is None:
            raise self.failed(f"the reply cannot be read: {first_line(attempt)}")
        return replace(attempt, verdict=Verdict((Check("read", True),), attempt.verdict.graph), errors="")

    def made(self, attempt: Attempt) -> LatentFunction:
        """The latent function of an attempt."""
        verdict = attempt.verdict
        return self.with_exchanges(
            replace(of_verdict(attempt.source, self.task, self.kind, verdict), model=self.model.name)
        )

    def with_exchanges(self, function: LatentFunction) -> LatentFunction:
        """The function with all exchanges so far."""
        return replace(function, exchanges=tuple(exchange.model_dump() for exchange in self.recorder.exchanges))

    def failed(self, why: str) -> DesignFailed:
        return DesignFailed(f"task {self.task.name!r}: {why}", self.recorder, self.model.name)


def check_recorded(task: TaskSpec, kind: Kind, draw: int, candidates: int) -> None:
    """Raise `LareError` if the shipped recordings lack a reply that a design needs when every candidate passes."""
    model, request = recorded_model(task.name, kind, draw), prompts.candidate(task, kind)
    replies = [model.reply(request, sample) for sample in range(candidates)]
    if candidates > 1:
        model.reply(prompts.combine(task, replies, kind), 0)


def quoted(reply: str) -> str:
    """A reply as it is shown to the model again: shortened, and never empty, because some servers refuse empty messages."""
    return reply[:LONGEST_QUOTE] if reply.strip() else "(an empty reply)"


def design(
    task: TaskSpec | str | Path,
    kind: Kind = "factors",
    model: Model | None = None,
    draw: int = 0,
    candidates: int = CANDIDATES,
    pre_verification: bool = True,
    record: Path | None = None,
    said: Callable[[str], None] = lambda _: None,
    steps: Steps | None = None,
) -> LatentFunction:
    """Ask a model for `phi` until one passes every check.

        xi_1 .. xi_n <- M(task, role)                       Eq. 2: candidates
        xi           <- M(task, role, xi_1..n)              Eq. 3: combine
        err          <- verify(phi, s)
        xi           <- M(task, role, xi_1..n, err)         Eq. 4: correct, while there are errors

    Args:
        task: a name, a path, or a spec.
        kind: several factors, or one reward.
        model: the language model to ask. Without one, the shipped recordings answer.
        draw: the number of the shipped recording that answers (0 to 4). It is independent of the training seed.
        candidates: n; with 1 (the paper's ablation without self-prompting), the single candidate is the function and
            nothing is combined.
        pre_verification: without it (the paper's ablation), the first function is kept if it can be read.
        record: the file to which every exchange is written, from the first reply on.
        said: a function that receives messages about the progress.
        steps: observations (n, observation size) and actions (n, action size) that functions are tried on if there is no
            environment, as `lare_rl.logged_steps` reads them from a data set.

    Raises:
        DesignFailed: no attempt passed. `DesignBroken` if the model became unavailable, `DesignStopped` after Ctrl-C.
        LareError: the model cannot answer, the environment does not run, or each team of the task needs its own function.
    """
    task = the_role(as_task(task))
    if model is not None and not isinstance(model, Model):
        raise LareError(f"a model must have a name and a method reply(messages, sample): {shortened(model)} does not")
    if not 1 <= candidates <= MOST_CANDIDATES:
        raise LareError(f"candidates = {candidates}: from 1 to {MOST_CANDIDATES}")
    model = model or recorded_model(task.name, kind, draw)
    # Detects an environment that does not run before a model is paid.
    sample_steps(task, steps)
    recorder = Recorder(task.name, kind, getattr(model, "temperature", None), record)
    conversation = Conversation(task, kind, model, recorder, said, steps)
    try:
        request, reply = conversation.begin(candidates, pre_verification)
        attempt = conversation.correct(request, reply) if pre_verification else conversation.once(reply)
    except DesignFailed:
        raise
    except LareError as error:
        if not recorder.exchanges:
            raise
        raise DesignBroken(str(error), recorder, model.name) from error
    except KeyboardInterrupt:
        if not recorder.exchanges:
            raise
        raise DesignStopped("stopped", recorder, model.name) from None
    return conversation.made(attempt)
