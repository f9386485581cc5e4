"""The interface of a language model: a name, and replies. The design loop uses nothing else of a model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from lare_rl.errors import LareError
from lare_rl.llm.prompts import Kind, Message
from lare_rl.llm.recording import RecordedModel, read_recording, shipped_recordings
from lare_rl.util.safe_io import read_text

__all__ = ["RECORDED", "Model", "recorded_model"]


@runtime_checkable
class Model(Protocol):
    """A language model."""

    name: str

    def reply(self, messages: Sequence[Message], sample: int) -> str:
        """Return the text of reply number `sample` (0, 1, ...) to the same request. Raises `LareError` if there is no reply."""
        ...


RECORDED = "recorded"
"""The name of the model that answers from the shipped recordings."""


def recorded_model(task: str, kind: Kind, draw: int = 0, path: Path | None = None) -> RecordedModel:
    """Return a model that answers from a file, or from the shipped recordings of that kind and draw.

    Raises:
        LareError: the file or draw does not exist, or the file is not a recording.
    """
    if path is None:
        return RecordedModel(shipped_recordings(kind, draw), task)
    try:
        text = read_text(path)
    except LareError as error:
        raise LareError(f"the recording {error}") from error
    return RecordedModel([read_recording(text, str(path))], task)
