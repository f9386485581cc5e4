"""Asks a language model for a phi over turns, and for corrections until it passes."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from lare_rl.errors import LareError
from lare_rl.latent.design import correct_until_passing, keep_replies
from lare_rl.latent.function import normalise_source
from lare_rl.llm.model import Model, ModelFunction, as_model
from lare_rl.llm.prompts import Message
from lare_rl.llm.recorder import Recorder
from lare_rl.llm.reply import parse_reply
from lare_rl.phi.turn_program import shorten
from lare_rl.turns.messages import Turn, read_function, to_json
from lare_rl.turns.phi import TurnPhi, find_problems, read_turn_phi
from lare_rl.util.sanitize import replace_surrogates

__all__ = ["choose_examples", "design_turn_phi", "turn_request"]

N_EXAMPLES = 5
"""The number of turns that `choose_examples` returns at most."""
MAX_EXCERPT = 1500
"""The number of characters that are shown of each text of an example, at most."""


def design_turn_phi(
    goal: str,
    tools: Sequence[Mapping[str, Any]],
    turns: Sequence[Turn],
    model: Model | ModelFunction,
    *,
    examples: Sequence[Turn] | None = None,
    record: str | Path | None = None,
) -> TurnPhi:
    """Ask a model for a phi over turns until one passes.

    Args:
        goal: what the agent is to do.
        tools: the descriptions of its tools, in the form of OpenAI's chat completions.
        turns: the turns that programs are checked on, such as those of some rollouts (`split_turns`).
        model: the language model, as for `lare_rl.design`.
        examples: the turns that the model sees. The default is at most five of `turns`, of different tools.
        record: the file to which every exchange is written.

    Raises:
        LareError: there are fewer than 2 turns, a tool has no name, `record` exists, or the model does not answer the first
            request. A `DesignError`, with the replies: no attempt passed, or the model does not answer a later request.
    """
    if len(turns) < 2:
        raise LareError(f"a phi over turns is checked on at least 2 turns, and not on {len(turns)}")
    model = as_model(model)
    request = turn_request(goal, tools, choose_examples(turns) if examples is None else examples)
    path = None if record is None else Path(record)
    recorder = Recorder(model, "turns", "events", path)

    def examine(reply: str) -> tuple[TurnPhi | None, str]:
        try:
            phi = read_turn_phi(normalise_source(parse_reply(reply).functions))
        except LareError as error:
            return None, replace_surrogates(str(error))
        return phi, replace_surrogates(find_problems(phi, turns))

    with keep_replies(recorder):
        reply = recorder.ask("candidate", request)
        phi = correct_until_passing(recorder, request, reply, examine)
    assert phi is not None  # because it has passed
    return replace(phi, model=model.name)


def turn_request(goal: str, tools: Sequence[Mapping[str, Any]], turns: Sequence[Turn]) -> list[Message]:
    """Return the messages that ask for a phi over turns, with example turns.

    The same arguments always give the same messages, so that a recorded reply can be found.

    Raises:
        LareError: a tool has no name, or parameters that are not JSON.
    """
    system = (files("lare_rl.llm") / "templates" / "turn_events.txt").read_text(encoding="utf-8").strip()
    examples = "\n\n".join(f"## Turn {number}\n{_show_turn(turn)}" for number, turn in enumerate(turns, start=1))
    sections = (("Task", goal), ("Tools", "\n\n".join(map(_show_tool, tools))), ("Example turns", examples))
    user = "\n\n".join(f"# {title}\n{text.strip()}" for title, text in sections)
    return [{"role": "system", "content": system}, {"role": "user", "content": replace_surrogates(user)}]


def choose_examples(turns: Sequence[Turn]) -> list[Turn]:
    """Return at most `N_EXAMPLES` turns in their order: the first with each combination of tools, then the second, and so on.

    Turns with the tools and the results of an earlier turn are left out.
    """
    candidates, counts, contents = [], Counter(), set()
    for index, turn in enumerate(turns):
        tools = tuple(call.tool for call in turn.calls)
        content = tools, tuple(call.result for call in turn.calls) or (turn.reply,)
        if content not in contents:
            contents.add(content)
            counts[tools] += 1
            candidates.append((counts[tools], index))
    return [turns[index] for index in sorted(index for _, index in sorted(candidates)[:N_EXAMPLES])]


def _show_tool(tool: Mapping[str, Any]) -> str:
    function = read_function(tool, "a tool")
    name, description = function["name"], str(function.get("description") or "").strip()
    parameters = to_json(function.get("parameters") or {}, f"the parameters of the tool {name!r}", ensure_ascii=False)
    return f"## {name}\n{description}\nParameters: {parameters}"


def _show_turn(turn: Turn) -> str:
    lines = [f"text: {json.dumps(shorten(turn.text, MAX_EXCERPT), ensure_ascii=False)}"]
    for call in turn.calls:
        lines.append(f"tool: {json.dumps(call.tool, ensure_ascii=False)}")
        arguments = call.arguments if call.arguments.isprintable() else json.dumps(call.arguments, ensure_ascii=False)
        lines.append(f"arguments: {shorten(arguments, MAX_EXCERPT)}")
        lines.append(f"result: {json.dumps(shorten(call.result, MAX_EXCERPT), ensure_ascii=False)}")
    if turn.reply:
        lines.append(f"the user's answer: {json.dumps(shorten(turn.reply, MAX_EXCERPT), ensure_ascii=False)}")
    return "\n".join(lines)
