"""Candidates, combine, verify, correct: lines 2 and 3 of Algorithm 1 of the LaRe paper."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lare.errors import LareError
from lare.latent.function import LatentFunction
from lare.latent.namespace import normal
from lare.latent.verify import verify
from lare.llm import prompts
from lare.llm.client import Model, RecordedModel, shipped_recordings
from lare.llm.prompts import Kind, Message, Stage
from lare.llm.reply import MalformedReply, parse
from lare.tasks.spec import TaskSpec

CANDIDATES = 5
"""n of the paper."""

ATTEMPTS = 5
"""How often a function is verified, the first time included, before the loop gives up."""


def design(
    task: TaskSpec,
    kind: Kind = "factors",
    model: Model | None = None,
    draw: int = 0,
    candidates: int = CANDIDATES,
) -> LatentFunction:
    """Ask a model for `phi` until there is one that passes every check.

        xi_1 .. xi_n <- M(task, role)                       Eq. 2: candidates
        xi           <- M(task, role, xi_1..n)              Eq. 3: combine
        err          <- verify(phi, s)
        xi           <- M(task, role, xi_1..n, err)         Eq. 4: correct, while there are errors

    Args:
        model: whom to ask; without one, the shipped recordings.
        draw: which of the shipped recordings answers (0 to 4). Nothing to do with a training seed.
        candidates: n; with 1, the single candidate is the function and nothing is combined.

    Raises:
        LareError: the model cannot answer, or no attempt passed.
    """
    if candidates < 1:
        raise LareError(f"candidates = {candidates}: at least one is needed")
    model = model or RecordedModel(shipped_recordings(kind, draw), task.name)
    exchanges: list[dict[str, Any]] = []

    def ask(stage: Stage, messages: Sequence[Message], times: int = 1) -> list[str]:
        replies = [model.reply(messages, sample) for sample in range(times)]
        exchanges.append({"stage": stage, "messages": list(messages), "replies": replies})
        return replies

    conversation = prompts.candidate(task, kind)
    replies = ask("candidate", conversation, candidates)
    if candidates > 1:
        conversation = prompts.combine(task, replies, kind)
        replies = ask("combine", conversation)
    reply, errors = replies[0], ""
    for attempt in range(ATTEMPTS):
        function, errors = examine(reply, task, kind)
        if function is not None:
            return replace(function, model=model.name, exchanges=tuple(exchanges))
        if attempt + 1 < ATTEMPTS:
            conversation = prompts.correct(conversation, reply, errors)
            reply = ask("correct", conversation)[0]
    raise LareError(f"task {task.name!r}: none of {ATTEMPTS} attempts passed; the last one failed: {errors}")


def examine(reply: str, task: TaskSpec, kind: Kind) -> tuple[LatentFunction | None, str]:
    """The verified function of a reply, or what is wrong with it."""
    try:
        source = normal(parse(reply).functions)
    except MalformedReply as error:
        return None, str(error)
    verdict = verify(source, task, kind)
    if not verdict.passed:
        return None, verdict.errors
    return LatentFunction(task.name, kind, source, verdict.size, verdict.checks), ""
