"""Asks a model, and records every exchange of a design."""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lare_rl.errors import LareError
from lare_rl.llm.key import redact_key
from lare_rl.llm.model import Model, ask
from lare_rl.llm.prompts import Message, Stage
from lare_rl.llm.recording import Exchange, Recording, RecordingKind, read_recording
from lare_rl.util.files import check_new_path, write_bytes
from lare_rl.util.safe_io import read_text

__all__ = ["Recorder"]


@dataclass
class Recorder:
    """Asks a model, and records its replies. With a `path`, it saves them to this file after each reply.

    Other files are never overwritten: the file must not exist at first, or be a recording of the same task and kind with exactly
    the `exchanges` that are passed here. After each reply it is replaced as a whole, so that no reply is lost.
    """

    model: Model
    task: str
    kind: RecordingKind
    path: Path | None = None
    exchanges: list[Exchange] = field(default_factory=list)
    owns_file: bool = field(init=False, default=False)
    """Whether the file at `path` is this recorder's, so that it may be replaced."""
    is_saved: bool = field(init=False, default=False)
    """Whether the file has the last reply."""

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
        current, keys = read_recording(self.to_json(), ""), {"task", "kind", "exchanges"}
        return saved.model_dump(include=keys) == current.model_dump(include=keys)

    def ask(self, stage: Stage, messages: Sequence[Message]) -> str:
        """Return a new reply to a request, and record it. If the last request was the same, the reply is added to its replies.

        Raises `LareError` if the model does not reply, or the file cannot be written.
        """
        request = stage, list(messages)
        same = [exchange for exchange in self.exchanges if (exchange.stage, exchange.messages) == request]
        reply = ask(self.model, messages, sum(len(exchange.replies) for exchange in same))
        is_last = bool(same) and same[-1] is self.exchanges[-1]
        earlier = same[-1].replies if is_last else []
        exchange = Exchange(stage=stage, messages=list(messages), replies=[*earlier, reply])  # it may be refused
        self.exchanges[len(self.exchanges) - is_last :] = [exchange]
        self.is_saved = False
        if self.path is not None:
            self.save(self.path, new=not self.owns_file)
            self.owns_file = self.is_saved = True
        return reply

    def save(self, path: Path, new: bool = True) -> None:
        """Write the recording to a file. Raises `LareError` if the file cannot be written, or it exists and should be `new`."""
        if new:
            check_new_path(path)
        write_bytes(path, self.to_json().encode())

    def to_json(self) -> str:
        """Return the content of the file, without the key. It has one name of a model: that of the last reply."""
        recording = Recording(
            task=self.task,
            kind=self.kind,
            draw=0,
            model=self.model.name,
            recorded=datetime.date.today().isoformat(),
            temperature=getattr(self.model, "temperature", None),
            exchanges=self.exchanges,
        )
        return redact_key(recording.model_dump_json(indent=1)) + "\n"
