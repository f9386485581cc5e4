"""Recordings: a model's replies to exact requests, kept in a file, and the model that answers from them."""

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from lare_rl.errors import Checked, LareError
from lare_rl.llm.key import without_key
from lare_rl.llm.prompts import Kind, Message, Stage
from lare_rl.util.files import replace
from lare_rl.util.safe_io import read_json

SHIPPED = files("lare_rl.llm") / "recordings"


class Exchange(Checked):
    """A request and the replies to it, unchanged."""

    stage: Stage
    messages: list[Message]
    replies: list[str]


class Recording(Checked):
    """One complete sample of a model: its candidates and their combination (and corrections, if there were any)."""

    task: str
    kind: Kind
    draw: int
    model: str
    recorded: str
    temperature: float | None
    exchanges: list[Exchange]


def shipped_recordings(kind: Kind, draw: int) -> list[Recording]:
    """The recordings of that kind and draw that come with the package, by task.

    Raises:
        LareError: no recording has that draw.
    """
    ending = f".draw{draw}.json"
    entries = sorted((SHIPPED / kind).iterdir(), key=lambda entry: entry.name)
    found = [entry for entry in entries if entry.name.endswith(ending)]
    if not found:
        draws = sorted({int(entry.name.split(".draw")[1].removesuffix(".json")) for entry in entries})
        raise LareError(f"no recording of {kind} has draw {draw}; the draws are {', '.join(map(str, draws))}")
    return [read_recording(entry.read_text(encoding="utf-8"), entry.name) for entry in found]


def read_recording(text: str, name: str) -> Recording:
    """Parse a recording. Raises `LareError` if `text` is not one; the message contains `name`."""
    try:
        values = read_json(text)
        json.dumps(values, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise LareError(f"recording {name} holds half a character (a surrogate), which no file can keep") from error
    except ValueError as error:
        raise LareError(f"recording {name} is not JSON: {error}") from error
    if not isinstance(values, dict):
        raise LareError(f"recording {name} is JSON, but not an object")
    if "Functions" in values:
        raise LareError(
            f"{name} is a single reply, not a recording of requests and their replies: lare-rl verify {name} --task TASK reads the "
            "function in it"
        )
    try:
        return Recording(**values)
    except LareError as error:
        raise LareError(f"recording {name}: {error}") from error


class RecordedModel:
    """Answers requests that match a recorded one word for word, and no others."""

    def __init__(self, recordings: Sequence[Recording], task: str):
        """`task` is named in the error for an unknown request."""
        self.recordings = recordings
        self.task = task
        self.name = "recorded"

    def reply(self, messages: Sequence[Message], sample: int) -> str:
        for recording in self.recordings:
            replies = [
                reply
                for exchange in recording.exchanges
                if exchange.messages == list(messages)
                for reply in exchange.replies
            ]
            if sample < len(replies):
                self.name = f"{recording.model}, recorded {recording.recorded}, draw {recording.draw}"
                return replies[sample]
        raise LareError(
            f"no recorded reply fits this request for task {self.task!r} (reply {sample + 1}): only the shipped tasks have "
            "recorded replies, for their exact texts. Ask a model (lare-rl design TASK --model NAME --out phi.py), train with a "
            "function that you have (--function phi.py; in a sweep file, the table [functions]), or by a method that needs none "
            "(--method bayes)"
        )


@dataclass
class Recorder:
    """Records every exchange of a design, and saves it to `path`, if there is one, after each reply.

    An existing file is never overwritten: the file must not exist when the first reply comes. After that it is replaced as a
    whole, so that no reply is lost.
    """

    task: str
    kind: Kind
    temperature: float | None = None
    path: Path | None = None
    exchanges: list[Exchange] = field(default_factory=list)
    begun: bool = False
    """Whether this recorder has created the file."""

    def asked(self, stage: Stage, messages: Sequence[Message]) -> int:
        """How many replies to a request are recorded already."""
        return sum(len(one.replies) for one in self.exchanges if (one.stage, one.messages) == (stage, list(messages)))

    def take(self, stage: Stage, messages: Sequence[Message], reply: str, model: str) -> None:
        """Add a reply to a request. If the last request was the same, the reply is added to its replies."""
        if self.exchanges and (self.exchanges[-1].stage, self.exchanges[-1].messages) == (stage, list(messages)):
            last = self.exchanges.pop()
            replies = [*last.replies, reply]
        else:
            replies = [reply]
        self.exchanges.append(Exchange(stage=stage, messages=list(messages), replies=replies))
        if self.path is not None:
            self.keep(model)

    def keep(self, model: str) -> None:
        """Write all exchanges to `path`."""
        assert self.path is not None
        self.write(self.path, model, new=not self.begun)
        self.begun = True

    def write(self, path: Path, model: str, new: bool = True) -> None:
        """Write the recording. Raises `LareError` if the file cannot be written, or if it exists and should be `new`."""
        try:
            if new:
                path.touch(exist_ok=False)
            try:
                replace(path, lambda file: file.write(self.text(model).encode()))
            except OSError:
                if new:
                    path.unlink(missing_ok=True)
                raise
        except FileExistsError:
            raise LareError(f"{path} exists, and is not overwritten; choose another file") from None
        except OSError as error:
            raise LareError(f"{path} cannot be written: {error.strerror}") from error

    def text(self, model: str) -> str:
        """The contents of the file."""
        recording = Recording(
            task=self.task,
            kind=self.kind,
            draw=0,
            model=model,
            recorded=datetime.date.today().isoformat(),
            temperature=self.temperature,
            exchanges=self.exchanges,
        )
        return without_key(recording.model_dump_json(indent=1)) + "\n"
