"""From a task to the messages that a language model gets: candidate, combine, correct, reflect.

Every text is stripped of surrounding white space. A request is a list of messages. The same task always gives the same
request, byte for byte, because recorded replies are found by the request.
"""

from collections.abc import Sequence
from importlib.resources import files
from typing import Literal, get_args

from lare_rl.errors import LareError, short_repr
from lare_rl.tasks.spec import FILL_IN, TaskSpec, unwritten_texts

__all__ = [
    "MAX_ATTEMPTS", "MAX_CANDIDATES", "N_CANDIDATES", "FunctionKind", "Message", "Stage", "candidate", "check_kind", "combine",
    "correct", "quote", "reflect",
]  # fmt: skip

N_CANDIDATES = 5
"""The default number of candidates for a function: n in line 2 of the paper's Algorithm 1."""
MAX_CANDIDATES = 100
"""The largest number of candidates for a function."""
MAX_ATTEMPTS = 5
"""Attempts at a function that passes, the first included."""
_MAX_QUOTE = 20_000
"""Characters of a failed reply that the model sees again."""

FunctionKind = Literal["factors", "reward"]
"""What a function returns: several factors (LaRe), or one reward (LLM reward design)."""

Stage = Literal["candidate", "combine", "correct", "reflect"]

Message = dict[str, str]
"""`role` ("system", "user" or "assistant") and `content`."""


def check_kind(kind: str) -> None:
    """Raise `LareError` if there is no such kind of function."""
    if kind not in get_args(FunctionKind):
        raise LareError(f"kind = {short_repr(kind)}: it is {' or '.join(get_args(FunctionKind))}")


def _template(name: str) -> str:
    return (files("lare_rl.llm") / "templates" / f"{name}.txt").read_text(encoding="utf-8").strip()


def candidate(task: TaskSpec, kind: FunctionKind = "factors") -> list[Message]:
    """Return the first request: the role, and the task (the paper's Eq. 2).

    Raises `LareError` if a text of the task is not filled in.
    """
    if keys := unwritten_texts(task):
        raise LareError(
            f"task {task.name!r}: {keys[0]} still says {FILL_IN!r}. Replace it by what a language model must know; a phi of your own "
            "(--function) and --method bayes need no texts."
        )
    sections = (("Task", task.description), ("Observation", task.observation), ("Action", task.action))
    user = "\n\n".join(f"# {title}\n{text.strip()}" for title, text in sections)
    return [{"role": "system", "content": _template(kind)}, {"role": "user", "content": user}]


def combine(task: TaskSpec, replies: Sequence[str], kind: FunctionKind = "factors") -> list[Message]:
    """Return the request that merges the candidates into one (Eq. 3)."""
    attempts = "\n\n".join(f"Attempt {number}:\n{reply.strip()}" for number, reply in enumerate(replies, start=1))
    return [*candidate(task, kind), *_answer(attempts, _template("combine"))]


def correct(conversation: Sequence[Message], reply: str, errors: str) -> list[Message]:
    """Return the request that shows the model the errors of its function (Eq. 4)."""
    return [*conversation, *_answer(quote(reply), _template("correct").replace("{error}", errors.strip()))]


def reflect(task: TaskSpec, reply: str, evidence: str, kind: FunctionKind = "factors") -> list[Message]:
    """Return the request that shows how a function's factors relate to the returns of episodes. It is not in the paper."""
    return [*candidate(task, kind), *_answer(reply, _template("reflect").replace("{evidence}", evidence))]


def quote(reply: str) -> str:
    """Shorten a reply that the model sees again. It must not be empty, because some servers refuse empty messages."""
    return reply[:_MAX_QUOTE] if reply.strip() else "(an empty reply)"


def _answer(reply: str, request: str) -> list[Message]:
    """Return the model's last reply, and what the user writes to it."""
    return [{"role": "assistant", "content": reply.strip()}, {"role": "user", "content": request}]
