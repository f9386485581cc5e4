"""Candidates, combine, verify, correct: lines 2 and 3 of Algorithm 1 of the LaRe paper."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

from lare_rl.envs.load import resolve_task
from lare_rl.errors import LareError, check_count
from lare_rl.latent.function import LatentFunction, function_from_verdict, normalise_source
from lare_rl.latent.verify import Check, Steps, Verdict, sample_steps, verify
from lare_rl.llm import prompts
from lare_rl.llm.model import Model, ModelFunction, as_model, recorded_model
from lare_rl.llm.prompts import MAX_ATTEMPTS, MAX_CANDIDATES, N_CANDIDATES, FunctionKind, Message, check_kind
from lare_rl.llm.recorder import Recorder
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.tasks.spec import TaskSpec, require_role

__all__ = [
    "Conversation", "DesignError", "check_recorded", "correct_until_passing", "design", "examine_reply",
    "keep_replies",
]  # fmt: skip

_Result = TypeVar("_Result")


class DesignError(LareError):
    """No attempt passed, or an error or Ctrl-C came after the first reply.

    Attributes:
        recorder: holds the model, and all exchanges with it.
        status: the exit status of the command line: 1 if no attempt passed, 130 after Ctrl-C, and 2 for another error.
    """

    def __init__(self, message: str, recorder: Recorder, status: int = 1):
        super().__init__(message)
        self.recorder, self.status = recorder, status


@contextlib.contextmanager
def keep_replies(recorder: Recorder) -> Iterator[None]:
    """If an error or Ctrl-C comes after the first reply, raise a `DesignError` that has the replies."""
    try:
        yield
    except (LareError, KeyboardInterrupt) as error:
        if isinstance(error, DesignError) or not recorder.exchanges:
            raise
        status = 2 if isinstance(error, LareError) else 130
        raise DesignError(str(error) or "stopped", recorder, status) from error


def correct_until_passing(
    recorder: Recorder,
    request: list[Message],
    reply: str,
    examine: Callable[[str], tuple[_Result, str]],
    on_message: Callable[[str], None] = lambda _: None,
) -> _Result:
    """Examine the reply to a request, and ask for corrections until one has no errors.

    Args:
        examine: returns what a reply says, and its errors, which are empty if it passes.

    Raises:
        DesignError: no attempt has passed.
    """
    result, errors = examine(reply)
    for number in range(1, MAX_ATTEMPTS + 1):
        on_message(f"attempt {number}: {_summarise(errors)}")
        if not errors:
            return result
        if number < MAX_ATTEMPTS:
            request = prompts.correct(request, reply, errors)
            reply = recorder.ask("correct", request)
            result, errors = examine(reply)
    reason = f"none of {MAX_ATTEMPTS} attempts passed; the last one failed: {_summarise(errors)}"
    raise DesignError(f"{recorder.task}: {reason}", recorder)


def _summarise(errors: str) -> str:
    """Return the first error and the number of the others, in one line; "passes" if there is none."""
    lines = errors.splitlines() or ["passes"]
    return lines[0] + (f" (and {len(lines) - 1} more)" if len(lines) > 1 else "")


class Attempt(NamedTuple):
    """A reply, and the result of its verification."""

    reply: str
    source: str
    """It is empty if the reply could not be read."""
    verdict: Verdict


def examine_reply(reply: str, task: TaskSpec, kind: FunctionKind, steps: Steps | None = None) -> Attempt:
    """Read and verify a reply."""
    try:
        source = normalise_source(parse_reply(reply).functions)
    except MalformedReplyError as error:
        return Attempt(reply, "", Verdict((Check("reply", False, str(error)),)))
    return Attempt(reply, source, verify(source, task, kind, steps))


@dataclass(frozen=True)
class Conversation:
    """The requests to a model about a task."""

    task: TaskSpec
    kind: FunctionKind
    recorder: Recorder
    on_message: Callable[[str], None]
    steps: Steps | None = None
    """The steps that functions are tried on. The default is random steps of the environment."""

    def start(self, candidates: int, pre_verification: bool) -> tuple[list[Message], str]:
        """Ask for candidates and their combination. Return the last request and the reply to it.

        Only candidates that pass verification are combined. If none passes, or without pre-verification, all are combined.
        """
        request = prompts.candidate(self.task, self.kind)
        replies = [self.recorder.ask("candidate", request) for _ in range(candidates)]
        if candidates == 1:
            return request, replies[0]
        passing = []
        if pre_verification:
            attempts = [self._examine(reply) for reply in replies]
            for number, attempt in enumerate(attempts, start=1):
                self.on_message(f"candidate {number}: {_summarise(attempt.verdict.errors)}")
            passing = [attempt.reply for attempt in attempts if attempt.verdict.passed]
        request = prompts.combine(self.task, passing or list(map(prompts.quote, replies)), self.kind)
        return request, self.recorder.ask("combine", request)

    def correct(self, request: list[Message], reply: str) -> Attempt:
        """Verify a reply, and ask for corrections until one passes. Raises `DesignError` if no attempt has passed."""

        def examine(reply: str) -> tuple[Attempt, str]:
            attempt = self._examine(reply)
            return attempt, attempt.verdict.errors

        return correct_until_passing(self.recorder, request, reply, examine, self.on_message)

    def accept(self, reply: str) -> Attempt:
        """Accept a reply that can be read: the ablation without pre-verification. Raises `DesignError` if it cannot be read."""
        attempt = self._examine(reply)
        if attempt.verdict.graph is None:
            reason = f"the reply cannot be read: {_summarise(attempt.verdict.errors)}"
            raise DesignError(f"{self.task.name}: {reason}", self.recorder)
        return attempt._replace(verdict=Verdict((Check("read", True),), attempt.verdict.graph))

    def to_function(self, attempt: Attempt) -> LatentFunction:
        """Return the latent function of an attempt."""
        function = function_from_verdict(attempt.source, self.task, self.kind, attempt.verdict)
        return self.add_exchanges(replace(function, model=self.recorder.model.name))

    def add_exchanges(self, function: LatentFunction) -> LatentFunction:
        """Return the function with all exchanges so far."""
        return replace(function, exchanges=tuple(exchange.model_dump() for exchange in self.recorder.exchanges))

    def _examine(self, reply: str) -> Attempt:
        return examine_reply(reply, self.task, self.kind, self.steps)


def check_recorded(task: TaskSpec, kind: FunctionKind, draw: int, candidates: int) -> None:
    """Raise `LareError` if the shipped recordings lack a reply that a design needs. Every candidate is assumed to pass."""
    model, request = recorded_model(task.name, kind, draw), prompts.candidate(task, kind)
    replies = [model.reply(request, number) for number in range(candidates)]
    if candidates > 1:
        model.reply(prompts.combine(task, replies, kind), 0)


def design(
    task: TaskSpec | str | Path,
    kind: FunctionKind = "factors",
    model: Model | ModelFunction | None = None,
    draw: int = 0,
    candidates: int = N_CANDIDATES,
    pre_verification: bool = True,
    record: str | Path | None = None,
    on_message: Callable[[str], None] = lambda _: None,
    steps: Steps | None = None,
) -> LatentFunction:
    """Ask a model for `phi` until one passes every check.

        xi_1 .. xi_n <- M(task, role)                       Eq. 2: candidates
        xi           <- M(task, role, xi_1..n)              Eq. 3: combine
        err          <- verify(phi, s)
        xi           <- M(task, role, xi_1..n, err)         Eq. 4: correct, while there are errors

    M is the model, xi a reply, role the system message, s sampled steps, and err the errors that they show.

    Args:
        task: a name, a path, or a spec.
        kind: several factors, or one reward.
        model: the language model to ask: an object with `name` and `reply(messages, number)`, or a function from messages to a
            text. Without one, the shipped recordings answer.
        draw: the number of the shipped recording that answers (0 to 4), without a `model`. It is independent of the training seed.
        candidates: n. With 1 (the paper's ablation without self-prompting), nothing is combined.
        pre_verification: without it (the paper's ablation), the first function that can be read is accepted.
        record: the file to which every exchange is written, from the first reply on. It must not exist.
        on_message: called with messages about attempts.
        steps: observations (n, observation size) and actions (n, action size) that functions are tried on, instead of
            random steps of the environment, as `lare_rl.logged_steps` reads them from a data set.

    Raises:
        DesignError: no attempt passed, or an error or Ctrl-C came after the first reply.
        LareError: there is no such kind or draw, `candidates` is not from 1 to 100, the model does not answer the first request, a text
            of the task is not filled in, `record` exists, the environment does not run, or each team needs its own function.
    """
    task = require_role(resolve_task(task, playable=steps is None))
    check_kind(kind)
    candidates = check_count("candidates", candidates)
    if candidates > MAX_CANDIDATES:
        raise LareError(f"candidates = {candidates}: at most {MAX_CANDIDATES}")
    model = recorded_model(task.name, kind, draw) if model is None else as_model(model)
    sample_steps(task, steps)  # an environment that does not run is found before a model is paid
    path = None if record is None else Path(record)
    recorder = Recorder(model, task.name, kind, path)
    conversation = Conversation(task, kind, recorder, on_message, steps)
    with keep_replies(recorder):
        request, reply = conversation.start(candidates, pre_verification)
        attempt = conversation.correct(request, reply) if pre_verification else conversation.accept(reply)
    return conversation.to_function(attempt)
