"""Recordings: a model's replies to exact requests, saved in a file, and the model that answers from them."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Literal

from lare_rl.errors import CheckedModel, LareError
from lare_rl.llm.prompts import N_CANDIDATES, Message, Stage
from lare_rl.util.safe_io import read_json_object

__all__ = [
    "RECORDED", "SHIPPED_RECORDINGS", "Exchange", "RecordedModel", "Recording", "RecordingKind", "read_recording", "shipped_recordings",
]  # fmt: skip

RecordingKind = Literal["factors", "reward", "events"]
"""What a recorded function returns: factors or a reward of a step, or the events of a turn (`lare_rl.turns`)."""

RECORDED = "recorded"
"""The name of the model that answers from the shipped recordings."""

SHIPPED_RECORDINGS = files("lare_rl.llm") / "recordings"


class Exchange(CheckedModel):
    """A request and the replies to it, unchanged."""

    stage: Stage
    messages: list[Message]
    replies: list[str]


class Recording(CheckedModel):
    """One design by a model: its candidates, their combination, corrections and reflections, as far as there were any."""

    task: str
    kind: RecordingKind
    draw: int
    model: str
    """The name of the model that was asked last."""
    recorded: str
    """The date of the last reply (ISO)."""
    temperature: float | None
    exchanges: list[Exchange]


def shipped_recordings(kind: RecordingKind, draw: int) -> list[Recording]:
    """Return the recordings of that kind and draw that come with the package, in the order of their tasks' names.

    Raises `LareError` if no recording has that draw.
    """
    entries = sorted((SHIPPED_RECORDINGS / kind).iterdir(), key=lambda entry: entry.name)
    selected = [entry for entry in entries if entry.name.endswith(f".draw{draw}.json")]
    if not selected:
        draws = sorted({int(entry.name.split(".draw")[1].removesuffix(".json")) for entry in entries})
        raise LareError(f"no recording of {kind} has draw {draw}; the draws are {', '.join(map(str, draws))}")
    return [read_recording(entry.read_text(encoding="utf-8"), entry.name) for entry in selected]


def read_recording(text: str, name: str) -> Recording:
    """Parse a recording.

    Args:
        text: the content of a file.
        name: the name of the file, for error messages.

    Raises:
        LareError: the text is not a recording.
    """
    try:
        values = read_json_object(text)
        json.dumps(values, ensure_ascii=False).encode()  # raises for surrogates, which cannot be encoded
    except UnicodeEncodeError as error:
        raise LareError(f"recording {name} holds half a character (a surrogate), which no file can store") from error
    except ValueError as error:
        raise LareError(f"recording {name} is not valid JSON: {error}") from error
    if "Functions" in values:
        raise LareError(f"{name} is a single reply, not a recording: check it by lare-rl verify {name} --task TASK")
    try:
        return Recording(**values)
    except LareError as error:
        raise LareError(f"recording {name}: {error}") from error


@dataclass
class RecordedModel:
    """Answers requests that match a recorded one word for word, and no other requests.

    Only the line of an error may differ: a later version of the reader may find it more exactly.
    """

    recordings: Sequence[Recording]
    """The recordings to answer from, in this order."""
    task: str
    """The name of the task, for error messages."""
    name: str = field(init=False, default=RECORDED)
    """The name of the model whose reply was the last."""

    def reply(self, messages: Sequence[Message], number: int) -> str:
        """Return a recorded reply to a request. See `Model.reply`."""
        request = _without_lines(messages)
        for recording in self.recordings:
            replies = [
                reply for x in recording.exchanges if _without_lines(x.messages) == request for reply in x.replies
            ]
            if number < len(replies):
                self.name = f"{recording.model}, recorded {recording.recorded}, draw {recording.draw}"
                return replies[number]
        raise LareError(
            f"no recorded reply fits task {self.task!r} (reply {number + 1}): a recording answers only its exact requests (those "
            f"that are shipped: most shipped tasks, 1 or {N_CANDIDATES} candidates, no reflection). "
            "Ask a model (lare_rl.design(task, model=...), or lare-rl design TASK --model NAME --out phi.py), train with a "
            "function of your own (--function phi.py; in a sweep file, the table [functions]), or with a method that needs none "
            "(--method bayes)"
        )


def _without_lines(messages: Sequence[Message]) -> list[tuple[str, str]]:
    """Return role and content of messages, without the numbers of lines."""
    return [(message["role"], re.sub(r"\bline \d+\b", "line", message["content"])) for message in messages]
