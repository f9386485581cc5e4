"""Two sets of tools with example turns, for which replies of a language model are recorded."""

from importlib.resources import files
from typing import NamedTuple

from lare_rl.llm.prompts import Message
from lare_rl.turns.design import turn_request
from lare_rl.turns.messages import Turn, split_turns
from lare_rl.util.safe_io import read_json

__all__ = ["TOOL_SETS", "ToolSet", "load_tool_set"]

TOOL_SETS = ("repair", "shop")
"""Repairing a program, and serving the customer of a shop."""


class ToolSet(NamedTuple):
    """A task with tools."""

    goal: str
    tools: list[dict]
    turns: list[Turn]
    """All turns of an attempt."""
    examples: list[Turn]
    """Those that the language model sees."""

    @property
    def request(self) -> list[Message]:
        """The request for a phi over turns."""
        return turn_request(self.goal, self.tools, self.examples)


def load_tool_set(name: str) -> ToolSet:
    """Return one of `TOOL_SETS`."""
    values = read_json((files(__name__) / f"{name}.json").read_text(encoding="utf-8"))
    turns = split_turns(values["messages"], name)
    return ToolSet(values["goal"], values["tools"], turns, [turns[index] for index in values["examples"]])
