"""The request for a phi over turns: the task, the tools, and some example turns."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from lare_rl.errors import LareError, short_repr
from lare_rl.llm.prompts import Message
from lare_rl.phi.turn_program import shorten
from lare_rl.turns.messages import Turn

__all__ = ["N_EXAMPLES", "choose_examples", "turn_request"]

N_EXAMPLES = 5
"""The number of turns that the language model sees."""
MAX_EXCERPT = 1500
"""Characters of a text of an example."""


def turn_request(goal: str, tools: Sequence[Mapping[str, Any]], turns: Sequence[Turn]) -> list[Message]:
    """Return the messages that ask for a phi over turns. The same arguments always give the same request, byte for byte.

    Args:
        goal: what the agent is to do.
        tools: the descriptions of the tools, in the form of OpenAI's chat completions.
        turns: example turns.

    Raises:
        LareError: a tool has no name.
    """
    system = (files("lare_rl.llm") / "templates" / "turn_events.txt").read_text(encoding="utf-8").strip()
    examples = "\n\n".join(f"## Turn {number}\n{_show_turn(turn)}" for number, turn in enumerate(turns, start=1))
    sections = (("Task", goal), ("Tools", "\n\n".join(map(_show_tool, tools))), ("Example turns", examples))
    user = "\n\n".join(f"# {title}\n{text.strip()}" for title, text in sections)
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def choose_examples(turns: Sequence[Turn], n_examples: int = N_EXAMPLES) -> list[Turn]:
    """Return turns with new results, taking the tools in turn. They keep their order."""
    ranks, counts, results = [], {}, set()
    for index, turn in enumerate(turns):
        tools = tuple(call.tool for call in turn.calls)
        answer = tuple(call.result for call in turn.calls) or (turn.reply,)
        if answer in results:
            continue
        results.add(answer)
        counts[tools] = counts.get(tools, 0) + 1
        ranks.append((counts[tools], index))
    return [turns[index] for index in sorted(index for _, index in sorted(ranks)[:n_examples])]


def _show_tool(tool: Mapping[str, Any]) -> str:
    function = tool.get("function", tool)
    if not isinstance(function, Mapping) or not isinstance(function.get("name"), str):
        raise LareError(f"a tool must have a function with a name, and is {short_repr(tool)}")
    parameters = json.dumps(function.get("parameters", {}), ensure_ascii=False, sort_keys=True)
    return f"## {function['name']}\n{str(function.get('description', '')).strip()}\nParameters: {parameters}"


def _show_turn(turn: Turn) -> str:
    lines = [f"text: {json.dumps(shorten(turn.text, MAX_EXCERPT), ensure_ascii=False)}"]
    for call in turn.calls:
        lines.append(f"tool: {json.dumps(call.tool, ensure_ascii=False)}")
        lines.append(f"arguments: {shorten(call.arguments, MAX_EXCERPT)}")
        lines.append(f"result: {json.dumps(shorten(call.result, MAX_EXCERPT), ensure_ascii=False)}")
    if turn.reply:
        lines.append(f"the user's answer: {json.dumps(shorten(turn.reply, MAX_EXCERPT), ensure_ascii=False)}")
    return "\n".join(lines)
