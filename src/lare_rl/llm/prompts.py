"""From a task to the messages that a language model gets: candidate, combine, correct.

Every text is stripped of surrounding white space. A request is a list of messages. The same task always gives the same
request, byte for byte, because recorded replies are looked up by the request.
"""

from collections.abc import Sequence
from importlib.resources import files
from typing import Literal

from lare_rl.tasks.spec import TaskSpec

Kind = Literal["factors", "reward"]
"""What is asked for: several factors (LaRe), or one reward (LLM reward design)."""

Stage = Literal["candidate", "combine", "correct", "reflect"]

Message = dict[str, str]
"""`role` ("system", "user" or "assistant") and `content`."""


def template(name: str) -> str:
    return (files("lare_rl.llm") / "templates" / f"{name}.txt").read_text(encoding="utf-8").strip()


def candidate(task: TaskSpec, kind: Kind = "factors") -> list[Message]:
    """The first request: the role, and the task (the paper's Eq. 2)."""
    sections = (("Task", task.description), ("Observation", task.observation), ("Action", task.action))
    user = "\n\n".join(f"# {title}\n{text.strip()}" for title, text in sections)
    return [{"role": "system", "content": template(kind)}, {"role": "user", "content": user}]


def combine(task: TaskSpec, replies: Sequence[str], kind: Kind = "factors") -> list[Message]:
    """The request that merges the candidates into one (Eq. 3)."""
    attempts = "\n\n".join(f"Attempt {number}:\n{reply.strip()}" for number, reply in enumerate(replies, start=1))
    return [
        *candidate(task, kind),
        {"role": "assistant", "content": attempts},
        {"role": "user", "content": template("combine")},
    ]


def correct(conversation: Sequence[Message], reply: str, errors: str) -> list[Message]:
    """The request that carries the errors of a failed function back (Eq. 4)."""
    return [
        *conversation,
        {"role": "assistant", "content": reply.strip()},
        {"role": "user", "content": template("correct").replace("{error}", errors.strip())},
    ]


def reflect(task: TaskSpec, reply: str, evidence: str, kind: Kind = "factors") -> list[Message]:
    """The request that shows how a function's factors relate to the returns of whole episodes. Not in the paper."""
    return [
        *candidate(task, kind),
        {"role": "assistant", "content": reply.strip()},
        {"role": "user", "content": template("reflect").replace("{evidence}", evidence)},
    ]
