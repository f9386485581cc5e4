"""Reflection, an extension of the paper: the model sees how well its factors explain returns, and may improve its function.

The caller passes the function that assesses (`lare_rl.training.reflect`): no module of this package sees returns.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.latent.design import Conversation
from lare_rl.latent.function import LatentFunction, normalise_source
from lare_rl.llm import prompts
from lare_rl.llm.model import Model
from lare_rl.llm.recording import Exchange, Recorder
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.tasks.spec import TaskSpec

__all__ = ["Assessment", "improve"]


@dataclass(frozen=True)
class Assessment:
    """How well a function explains the returns of some episodes."""

    r2: float
    """R^2 of the returns, each predicted from the factors before it was used to fit; NaN if all returns are equal."""
    text: str
    """The description for the model: what the factors explain together, what each one explains, and what may be missing."""


def improve(
    function: LatentFunction,
    task: TaskSpec,
    model: Model,
    assess: Callable[[LatentFunction], Assessment],
    rounds: int = 1,
    record: str | Path | None = None,
    on_message: Callable[[str], None] = lambda _: None,
) -> LatentFunction:
    """Show the model how well a function explains returns, ask for a better one, and return the one that predicts returns best.

    After an error or an interruption, the best function so far is returned.

    Args:
        function: a verified function. New exchanges are appended to its exchanges.
        task: the task that the function is designed for.
        assess: assesses a function by the returns of some episodes, the same ones in each call. It may raise `LareError`.
        rounds: how often the model is asked for a better function.
        record: the file to which every exchange is written. If the design had a file, it is this file.

    Raises:
        LareError: `record` cannot be written, or it exists and is not the recording of the function's exchanges.
    """
    exchanges = [Exchange(**exchange) for exchange in function.exchanges]
    path = None if record is None else Path(record)
    recorder = Recorder(task.name, function.kind, getattr(model, "temperature", None), path, exchanges)
    conversation = Conversation(task, function.kind, model, recorder, on_message)
    try:
        best, assessment = function, assess(function)
        if math.isnan(assessment.r2):
            raise LareError(
                "the returns of all episodes are equal, and no function can predict them better than another"
            )
    except (LareError, KeyboardInterrupt) as error:
        on_message(f"no reflection: {str(error) or 'stopped'}")
        return function
    on_message(f"reflection: the factors of the first function predict unseen returns with R² = {assessment.r2:.3f}")
    for number in range(1, rounds + 1):
        try:
            request = prompts.reflect(task, _find_reply(best), assessment.text, function.kind)
            attempt = conversation.correct(request, conversation.ask("reflect", request))
            candidate = conversation.to_function(attempt)
            candidate_assessment = assess(candidate)
        except LareError as error:
            on_message(f"reflection {number}: {error}")
            continue
        except KeyboardInterrupt:
            on_message(f"reflection {number}: stopped")
            break
        is_better = candidate_assessment.r2 > assessment.r2
        on_message(f"reflection {number}: R² = {candidate_assessment.r2:.3f}, {'kept' if is_better else 'not better'}")
        if is_better:
            best, assessment = candidate, candidate_assessment
    return conversation.add_exchanges(best)


def _find_reply(function: LatentFunction) -> str:
    """Return the reply that a function was read from, or its source if no reply fits."""
    replies = [reply for exchange in function.exchanges for reply in exchange["replies"]]
    for reply in reversed(replies):
        try:
            if normalise_source(parse_reply(reply).functions) == function.source:
                return reply
        except MalformedReplyError:
            continue
    return function.source
