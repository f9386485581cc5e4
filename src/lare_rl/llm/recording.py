"""Recordings: a model's replies to exact requests, saved in a file, and the model that answers from them."""

import datetime
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Literal

from lare_rl.errors import CheckedModel, LareError
from lare_rl.llm.key import redact_key
from lare_rl.llm.prompts import N_CANDIDATES, Message, Stage
from lare_rl.util.files import check_new_path, write_bytes
from lare_rl.util.safe_io import read_json_object, read_text

__all__ = [
    "RECORDED", "SHIPPED_RECORDINGS", "Exchange", "RecordedModel", "Recorder", "read_recording", "shipped_recordings",
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


@dataclass
class Recorder:
    """Records every exchange of a design. With a `path`, it saves them to this file after each reply.

    Other files are never overwritten: the file must not exist at first, or be a recording of the same task and kind with exactly
    the `exchanges` that are passed here. After each reply it is replaced as a whole, so that no reply is lost.
    """

    task: str
    kind: RecordingKind
    temperature: float | None = None
    path: Path | None = None
    exchanges: list[Exchange] = field(default_factory=list)
    owns_file: bool = field(init=False, default=False)
    """Whether the file at `path` is this recorder's, so that it may be replaced."""

    def __post_init__(self) -> None:
        if self.path is not None:
            self.owns_file = self._is_recorded(self.path)
            if not self.owns_file:
                check_new_path(self.path)  # before a model is asked and paid

    def _is_recorded(self, path: Path) -> bool:
        """Return whether a file is a recording of the exchanges so far, of the same task and kind, as they are saved: without the key."""
        try:
            saved = read_recording(read_text(path), str(path))
        except LareError:
            return False
        current, keys = read_recording(self.to_json(""), ""), {"task", "kind", "exchanges"}
        return saved.model_dump(include=keys) == current.model_dump(include=keys)

    def n_replies(self, stage: Stage, messages: Sequence[Message]) -> int:
        """Return the number of recorded replies to a request."""
        request = stage, list(messages)
        return sum(len(x.replies) for x in self.exchanges if (x.stage, x.messages) == request)

    def add(self, stage: Stage, messages: Sequence[Message], reply: str, model: str) -> None:
        """Add a reply to a request. If the last request was the same, the reply is added to its replies.

        `model` is the name of the model that replied. A file has one name: that of its last reply.
        """
        last = self.exchanges[-1:]
        is_same = [(exchange.stage, exchange.messages) for exchange in last] == [(stage, list(messages))]
        earlier = last[0].replies if is_same else []
        exchange = Exchange(stage=stage, messages=list(messages), replies=[*earlier, reply])  # it may be refused
        self.exchanges[len(self.exchanges) - is_same :] = [exchange]
        if self.path is not None:
            self.save(self.path, model, new=not self.owns_file)
            self.owns_file = True

    def save(self, path: Path, model: str, new: bool = True) -> None:
        """Write the recording to a file. Raises `LareError` if the file cannot be written, or it exists and should be `new`."""
        if new:
            check_new_path(path)
        write_bytes(path, self.to_json(model).encode())

    def to_json(self, model: str) -> str:
        """Return the content of the file, without the key."""
        recording = Recording(
            task=self.task,
            kind=self.kind,
            draw=0,
            model=model,
            recorded=datetime.date.today().isoformat(),
            temperature=self.temperature,
            exchanges=self.exchanges,
        )
        return redact_key(recording.model_dump_json(indent=1)) + "\n"
