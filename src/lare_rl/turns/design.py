"""Asks a language model for a phi over turns: one attempt, and corrections until it passes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError
from lare_rl.latent.function import normalise_source
from lare_rl.llm.model import Model, ModelFunction, as_model
from lare_rl.llm.prompts import correct
from lare_rl.llm.recording import Recorder
from lare_rl.llm.reply import MalformedReplyError, parse_reply
from lare_rl.turns.messages import Turn
from lare_rl.turns.phi import TurnPhi, find_problems, read_turn_phi
from lare_rl.turns.prompt import choose_examples, turn_request

__all__ = ["MAX_ATTEMPTS", "DesignedTurnPhi", "design_turn_phi"]

MAX_ATTEMPTS = 5
"""Attempts at a program that passes, the first included."""
MAX_QUOTE = 20_000


@dataclass(frozen=True)
class DesignedTurnPhi:
    """A phi over turns, and where it comes from."""

    phi: TurnPhi
    model: str
    recorder: Recorder


def design_turn_phi(
    goal: str,
    tools: Sequence[Mapping[str, Any]],
    turns: Sequence[Turn],
    model: Model | ModelFunction,
    *,
    examples: Sequence[Turn] | None = None,
    record: Path | None = None,
) -> DesignedTurnPhi:
    """Ask a model for a phi over turns until one passes.

    Args:
        goal: what the agent is to do.
        tools: the descriptions of its tools, in the form of OpenAI's chat completions.
        turns: turns that programs are checked on, such as all of some rollouts (`split_turns`).
        model: the language model, as for `lare_rl.design`.
        examples: the turns that the model sees. The default is five of `turns`, of different tools.
        record: the file to which every exchange is written.

    Raises:
        LareError: the model cannot answer, or no attempt passed.
    """
    if len(turns) < 2:
        raise LareError(f"a phi over turns is checked on at least 2 turns, and not on {len(turns)}")
    model = as_model(model)
    request = turn_request(goal, tools, choose_examples(turns) if examples is None else examples)
    recorder = Recorder("turns", "events", getattr(model, "temperature", None), record)
    problems = ""
    for attempt in range(MAX_ATTEMPTS):
        reply = model.reply(request, 0)
        recorder.add("correct" if attempt else "candidate", request, reply, model.name)
        try:
            source = normalise_source(parse_reply(reply).functions)
            problems = find_problems(source, turns)
        except MalformedReplyError as error:
            problems = str(error)
        else:
            if not problems:
                return DesignedTurnPhi(read_turn_phi(source), model.name, recorder)
        request = correct(request, reply[:MAX_QUOTE] if reply.strip() else "(an empty reply)", problems)
    raise LareError(f"none of {MAX_ATTEMPTS} attempts passed; the last one failed: {problems.splitlines()[0]}")
