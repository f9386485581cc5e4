"""Reflection, an extension of the paper: the model sees how well its factors explain returns, and may improve its function.

The caller passes the judge (`lare_rl.training.reflect`), because no module of this folder has access to returns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.latent.design import Conversation
from lare_rl.latent.function import LatentFunction, normal
from lare_rl.llm import prompts
from lare_rl.llm.model import Model
from lare_rl.llm.recording import Exchange, Recorder
from lare_rl.llm.reply import MalformedReply, parse
from lare_rl.tasks.spec import TaskSpec


@dataclass(frozen=True)
class Evidence:
    """How well a function explains the returns of some episodes."""

    r2: float
    """R^2 of the returns, each predicted from the factors before it was seen; NaN if it cannot be computed."""
    text: str
    """The description for the model: what the factors explain together, what each one explains, and what may be missing."""


Judge = Callable[[LatentFunction], Evidence]
"""It must judge every function on the same episodes. It may raise `LareError` if a function fails on them."""


def improve(
    function: LatentFunction,
    task: TaskSpec,
    model: Model,
    judge: Judge,
    rounds: int = 1,
    record: Path | None = None,
    said: Callable[[str], None] = lambda _: None,
) -> LatentFunction:
    """Show the model how well a function explains returns, ask for a better one, and keep the one that predicts returns best.

    After an error or an interruption, the best function so far is returned.

    Args:
        function: a verified function. New exchanges are appended to its own.
        task: the task that the function is designed for.
        model: the language model to ask.
        judge: judges a function by the returns of some episodes.
        rounds: how often the model is asked for a better function.
        record: the file to which every exchange is written; the file of the design, if the design had one.
        said: a function that receives messages about the progress.
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
    said(f"reflection: the factors of the first function predict unseen returns with R² = {known.r2:.3f}")
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
        said(f"reflection {number}: R² = {found.r2:.3f}, {'kept' if better else 'not better'}")
        if better:
            best, known = new, found
    return conversation.with_exchanges(best)


def said_of(function: LatentFunction) -> str:
    """The reply that a function was read from; the function's source if there is no such reply."""
    replies = [reply for exchange in function.exchanges for reply in exchange["replies"]]
    for reply in reversed(replies):
        try:
            if normal(parse(reply).functions) == function.source:
                return reply
        except MalformedReply:
            continue
    return function.source
