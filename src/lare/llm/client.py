"""Models that answer requests. For now: those that answer from a recording.

A live model is anything with a `name` and a `reply`; the design loop knows no more of it.
"""

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Literal, Protocol, runtime_checkable

from lare.errors import Checked, LareError
from lare.llm.prompts import Kind, Message, Stage

SHIPPED = files("lare.llm") / "recordings"


@runtime_checkable
class Model(Protocol):
    """Whoever answers a request."""

    name: str

    def reply(self, messages: Sequence[Message], sample: int) -> str:
        """The text of answer number `sample` (0, 1, ...) to the same request. Raises `LareError`."""
        ...


class Exchange(Checked):
    """A request and the replies to it, as they came."""

    stage: Stage
    messages: list[Message]
    replies: list[str]


class Recording(Checked):
    """One complete sample of a model: its candidates and their combination (and corrections, if there were any)."""

    task: str
    kind: Literal["factors", "reward"]
    draw: int
    model: str
    recorded: str
    temperature: float | None
    exchanges: list[Exchange]


def shipped_recordings(kind: Kind, draw: int) -> list[Recording]:
    """The recordings of that kind and draw that come with the package, by task.

    Raises:
        LareError: there are none with that number.
    """
    ending = f".draw{draw}.json"
    entries = sorted((SHIPPED / kind).iterdir(), key=lambda entry: entry.name)
    found = [entry for entry in entries if entry.name.endswith(ending)]
    if not found:
        draws = sorted({int(entry.name.split(".draw")[1].removesuffix(".json")) for entry in entries})
        raise LareError(f"no recording of {kind} has draw {draw}; the draws are {', '.join(map(str, draws))}")
    return [read_recording(entry.read_text(encoding="utf-8"), entry.name) for entry in found]


def read_recording(text: str, name: str) -> Recording:
    """Raises `LareError` where `text` is not a recording; `name` says in the message which one."""
    try:
        return Recording(**json.loads(text))
    except LareError as error:
        raise LareError(f"recording {name}: {error}") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise LareError(f"recording {name} is not JSON: {error}") from error


class RecordedModel:
    """Answers the requests that it knows, word for word, and no others."""

    def __init__(self, recordings: Sequence[Recording], task: str):
        """`task` is named when a request is refused."""
        self.recordings = recordings
        self.task = task
        self.name = "recorded"

    def reply(self, messages: Sequence[Message], sample: int) -> str:
        for recording in self.recordings:
            for exchange in recording.exchanges:
                if exchange.messages == list(messages) and sample < len(exchange.replies):
                    self.name = f"{recording.model}, recorded {recording.recorded}, draw {recording.draw}"
                    return exchange.replies[sample]
        raise LareError(
            f"no recorded reply fits this request for task {self.task!r} (reply {sample + 1}): recordings answer only "
            "the exact texts of a shipped task, and the number of candidates that was recorded (or 1). Restore them, "
            "or give a function of your own with --function FILE"
        )
