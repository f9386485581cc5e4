"""Reflection, beyond the paper: the model is shown what returns say of its function, and may improve it.

Who judges is given: it knows returns, which nothing in this folder does (`lare.training.reflect`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lare.errors import LareError
from lare.latent.design import Conversation
from lare.latent.function import LatentFunction, normal
from lare.llm import prompts
from lare.llm.model import Model
from lare.llm.recording import Exchange, Recorder
from lare.llm.reply import MalformedReply, parse
from lare.tasks.spec import TaskSpec


@dataclass(frozen=True)
class Evidence:
    """What the returns of some episodes say of a function."""

    r2: float
    """How well they could have been told from the factors, each before it was seen; NaN where that cannot be said."""
    text: str
    """For the model: what the factors explain, each factor, and what they leave."""


Judge = Callable[[LatentFunction], Evidence]
"""The same episodes for every function that it is asked about. May raise `LareError` where a function fails on them."""


def improve(
    function: LatentFunction,
    task: TaskSpec,
    model: Model,
    judge: Judge,
    rounds: int = 1,
    record: Path | None = None,
    said: Callable[[str], None] = lambda _: None,
) -> LatentFunction:
    """Show the model what returns say of a function; keep the function whose factors tell returns best.

    Whatever goes wrong on the way, and whoever stops it, the best function so far is returned.

    Args:
        function: verified; its own exchanges are gone on with.
        task: that it is designed for.
        model: whom to ask.
        judge: what the returns of some episodes say.
        rounds: how often the model is asked for a better one.
        record: a file that takes every exchange; the one of the design, if that had one.
        said: is told how it goes.
    """
    exchanges = [Exchange(**one) for one in function.exchanges]
    recorder = Recorder(task.name, function.kind, getattr(model, "temperature", None), record, exchanges)
    recorder.begun = record is not None and bool(exchanges)
    conversation = Conversation(task, function.kind, model, recorder, said)
    try:
        best, known = function, judge(function)
    except (LareError, KeyboardInterrupt) as error:
        said(f"no reflection: {str(error) or 'stopped'}")
        return function
    said(f"reflection: before it, the factors tell unseen returns with R^2 = {known.r2:.3f}")
    for number in range(1, rounds + 1):
        try:
            request = prompts.reflect(task, said_of(best), known.text, function.kind)
            attempt = conversation.correct(request, conversation.ask("reflect", request))
            new = conversation.made(attempt)
            found = judge(new)
        except LareError as error:
            said(f"reflection {number}: {error}")
            continue
        except KeyboardInterrupt:
            said(f"reflection {number}: stopped")
            break
        better = found.r2 > known.r2
        said(f"reflection {number}: R^2 = {found.r2:.3f}, {'kept' if better else 'not better'}")
        if better:
            best, known = new, found
    return conversation.with_exchanges(best)


def said_of(function: LatentFunction) -> str:
    """The reply that a function was read from; its source, where a person wrote it."""
    replies = [reply for exchange in function.exchanges for reply in exchange["replies"]]
    for reply in reversed(replies):
        try:
            if normal(parse(reply).functions) == function.source:
                return reply
        except MalformedReply:
            continue
    return function.source
